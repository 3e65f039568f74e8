"""Worlds that are not as the shield was told, and what a robot's scanner sees of them.

told       as told
obstacle   something 0.3 m wide, on no map, stands on the way that was certified at the start
shift      walls and furniture stand 0.05 m from where the map has them, along x or y
collider   the robot's footprint lies 0.109 m behind its origin, and the shield was told that it is centred
person     someone steps into the narrowest place of the certified way when the robot comes near, and
           stays there for 20 steps
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from evaluation import disturbance
from specshield.arrays import Floats
from specshield.compiled import leaf
from specshield.robot.dynamics import Body
from specshield.sim.cases import Case
from specshield.sim.robot import Pose
from specshield.sim.senses import cast

WORLDS = ("told", "obstacle", "shift", "collider", "person")
PERSON, NEAR, LEAST = 0.4, 1.5, 0.6  # [m] how wide someone is; how near the robot comes; how near is too near
STAYS = 20  # [steps]
SCAN, REACH = math.pi, 2.0  # [rad], [m] of the scanner
RAYS = 181
INTO = 0.01  # [m] behind the surface that a ray meets lies what is occupied
RASTER = 0.05  # [m] points that share a square of this side are sent once
MOST = 2000  # points that a step may send


@dataclass(frozen=True, eq=False)
class World:
    """A world as it really is. busy: the same with someone in the way, at `place`; None: nobody comes."""

    case: Case
    busy: Case | None = None
    place: tuple[float, float] = (math.inf, math.inf)

    def is_triggered(self, pose: Pose) -> bool:
        """Whether someone steps in, now that the robot is at `pose`."""
        away = math.hypot(pose[0] - self.place[0], pose[1] - self.place[1])
        return self.busy is not None and LEAST < away < NEAR


def make_world(name: str, case: Case, way: Callable[[], Floats], random: np.random.Generator) -> World:
    """The world of one episode. way: gives the poses certified at the start, [n, 3]."""
    if name == "person":
        return _person(case, way())
    return World(disturbance.world("none" if name == "told" else name, case, way, random))


def _person(case: Case, way: Floats) -> World:
    """Someone at the narrowest place of the way that is far enough from its start."""
    grid = case.task.grid
    far = np.hypot(*(way[:, :2] - way[0, :2]).T) >= NEAR
    if not far.any():
        return World(case)
    rows = [case.cell((x, y)) for x, y, _ in way[far]]
    x, y, _ = way[far][int(np.argmin([grid.clearance[cell] for cell in rows]))].tolist()
    stands = np.hypot(*(grid.centres - (x, y)).transpose(2, 0, 1)) <= PERSON / 2
    busy = replace(case, task=replace(case.task, grid=replace(grid, occupied=grid.occupied | stands)))
    return World(case, busy, (x, y))


def look(body: Body, pose: Pose) -> tuple[Floats, Floats]:
    """What a scanner at the robot's origin sees: points [n, 2] that are occupied, and that are free."""
    ranges = np.empty(RAYS)
    _scan(body, *pose, ranges)
    return points_of(pose, ranges)


def points_of(pose: Pose, ranges: Floats) -> tuple[Floats, Floats]:
    """The points [n, 2] that ranges (RAYS,) show: what is occupied, and what is free before it."""
    angles = pose[2] + np.linspace(-SCAN / 2, SCAN / 2, RAYS)
    towards = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    hit = ranges < REACH
    occupied = pose[:2] + (ranges[hit, None] + INTO) * towards[hit]
    along = np.arange(RASTER / 2, REACH, RASTER)
    seen = pose[:2] + along[None, :, None] * towards[::2, None, :]
    free = seen[along[None, :] < ranges[::2, None] - INTO]
    return _once(occupied), _once(free)[:MOST]


def _once(points: Floats) -> Floats:
    """One point of each square of the raster."""
    _, first = np.unique(np.floor(points / RASTER), axis=0, return_index=True)
    return points[np.sort(first)]


@leaf
def _scan(body: Body, x: float, y: float, theta: float, out: Floats) -> None:
    for k in range(out.shape[0]):
        out[k] = cast(body, x, y, theta + math.pi * (k / (out.shape[0] - 1) - 0.5), 2.0)
