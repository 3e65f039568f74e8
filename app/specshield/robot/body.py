"""The robot on its map as the compiled functions take it, and questions about its motions.

A motion is an index into `Robot.motions`: go straight on, then turn on the spot. Either part may be zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bytes, Floats
from specshield.compiled import inlined, leaf
from specshield.robot.actions import Robot
from specshield.world.occupancy import OccupancyGrid


class Body(NamedTuple):
    """Grid, footprint and motions as the compiled functions take them. Metres, radians."""

    occupied: Bytes  # [height, width], row 0 lowest
    clearance: Floats  # [height, width] from a cell's centre to the nearest obstacle
    resolution: float
    origin_x: float
    origin_y: float
    cos_yaw: float
    sin_yaw: float
    radius: float
    offset_x: float
    offset_y: float
    stop: bool
    translate: Floats  # [M]
    rotate: Floats  # [M]


def make_body(robot: Robot, grid: OccupancyGrid) -> Body:
    """Prepares f once for a robot on a grid."""
    x, y, yaw = grid.origin
    motions = np.array(robot.motions, dtype=np.float64).reshape(-1, 2)
    return Body(
        occupied=np.ascontiguousarray(grid.occupied, dtype=np.uint8),
        clearance=np.ascontiguousarray(grid.clearance, dtype=np.float64),
        resolution=float(grid.resolution),
        origin_x=float(x),
        origin_y=float(y),
        cos_yaw=math.cos(yaw),
        sin_yaw=math.sin(yaw),
        radius=float(robot.radius),
        offset_x=float(robot.offset[0]),
        offset_y=float(robot.offset[1]),
        stop=robot.on_contact == "stop",
        translate=np.ascontiguousarray(motions[:, 0]),
        rotate=np.ascontiguousarray(motions[:, 1]),
    )


@inlined
def motion_count(body: Body) -> int:
    return int(body.translate.shape[0])


@inlined
def displacement(body: Body, motion: int) -> tuple[float, float]:
    """Where a motion leads if nothing hinders it: metres ahead, then radians counter-clockwise."""
    return body.translate[motion], body.rotate[motion]


def displacements(body: Body) -> tuple[Floats, Floats]:
    """The displacement of every motion: metres ahead [M] and radians [M]."""
    return body.translate, body.rotate


@leaf
def longest_motions(body: Body) -> tuple[float, float]:
    """The longest move [m] and the largest turn [rad] of all motions, 0 where there is none."""
    move, turn = 0.0, 0.0
    for motion in range(body.translate.shape[0]):
        move, turn = max(move, abs(body.translate[motion])), max(turn, abs(body.rotate[motion]))
    return move, turn


@leaf
def swing_radius(body: Body) -> float:
    """How far the footprint reaches from the robot's origin [m]: its turns touch nothing farther off."""
    return float(body.radius + math.hypot(body.offset_x, body.offset_y))


def calmest_motion(body: Body) -> int:
    """The motion that stands still, or else the smallest turn on the spot, or else the shortest move."""
    travel = np.abs(body.translate) + 1e-3 * np.abs(body.rotate)
    return int(np.argmin(travel))


@inlined
def wrap(theta: float) -> float:
    """The angle in (-pi, pi]."""
    if -math.pi < theta <= math.pi:
        return theta
    turns = math.ceil((theta - math.pi) / (2.0 * math.pi))
    theta -= turns * 2.0 * math.pi
    return theta if -math.pi < theta <= math.pi else math.pi


@inlined
def in_grid(body: Body, x: float, y: float) -> tuple[float, float]:
    """A point of the map in grid metres: along the grid's columns and rows from its lower-left corner."""
    dx, dy = x - body.origin_x, y - body.origin_y
    return body.cos_yaw * dx + body.sin_yaw * dy, body.cos_yaw * dy - body.sin_yaw * dx


@inlined
def centre(body: Body, x: float, y: float, theta: float) -> tuple[float, float]:
    """The footprint's centre in grid metres."""
    c, s = math.cos(theta), math.sin(theta)
    return in_grid(body, x + body.offset_x * c - body.offset_y * s, y + body.offset_x * s + body.offset_y * c)
