"""What the robot senses, compiled: a range scan around it, and the target where its camera sees it.

Egocentric: distances and bearings from where it stands and looks, never a pose or a map.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats
from specshield.compiled import leaf
from specshield.robot.dynamics import Body

RAYS = 36
REACH = 6.0  # [m] length of a ray
FIELD_OF_VIEW = math.radians(120.0)
SIGHT = 5.0  # [m] up to which the target is recognised


class Senses(NamedTuple):
    """ranges (RAYS,) [m]: to the nearest obstacle counter-clockwise from straight ahead, REACH at most.

    seen: whether the target is in the field of view, within SIGHT, and nothing hides it; then distance [m]
    and bearing [rad], otherwise 0. last_action: the one that was executed, None at first.
    """

    ranges: Floats
    seen: bool
    distance: float
    bearing: float
    last_action: int | None


@leaf
def scan(body: Body, x: float, y: float, theta: float, out: Floats) -> None:
    """Writes the ranges, shape (RAYS,)."""
    for k in range(out.shape[0]):
        out[k] = cast(body, x, y, theta + 2.0 * math.pi * k / out.shape[0], REACH)


@leaf
def see(body: Body, x: float, y: float, theta: float, tx: float, ty: float) -> tuple[bool, float, float]:
    """Whether the point (tx, ty) is seen, how far away it is [m], and its bearing from the heading [rad]."""
    distance = math.hypot(tx - x, ty - y)
    bearing = math.atan2(ty - y, tx - x) - theta
    bearing -= 2.0 * math.pi * round(bearing / (2.0 * math.pi))
    if distance > SIGHT or abs(bearing) > 0.5 * FIELD_OF_VIEW:
        return False, 0.0, 0.0
    if cast(body, x, y, theta + bearing, distance) < distance:
        return False, 0.0, 0.0
    return True, distance, bearing


@leaf
def cast(body: Body, x: float, y: float, angle: float, reach: float) -> float:
    """How far [m] a ray goes from (x, y) until it enters an occupied cell, `reach` at most.

    Cell by cell (Amanatides and Woo, 1987). Outside the grid everything is occupied.
    """
    h = body.resolution
    dx, dy = x - body.origin_x, y - body.origin_y
    u, v = (body.cos_yaw * dx + body.sin_yaw * dy) / h, (body.cos_yaw * dy - body.sin_yaw * dx) / h
    c, s = math.cos(angle), math.sin(angle)
    du, dv = body.cos_yaw * c + body.sin_yaw * s, body.cos_yaw * s - body.sin_yaw * c
    height, width = body.occupied.shape
    if not (0.0 <= u < width and 0.0 <= v < height):
        return 0.0
    col, row = math.floor(u), math.floor(v)
    right, up = (1 if du > 0.0 else -1), (1 if dv > 0.0 else -1)
    across = 1.0 / abs(du) if du != 0.0 else np.inf
    along = 1.0 / abs(dv) if dv != 0.0 else np.inf
    next_u = ((col + 1 - u) if du > 0.0 else (u - col)) * across if du != 0.0 else np.inf
    next_v = ((row + 1 - v) if dv > 0.0 else (v - row)) * along if dv != 0.0 else np.inf
    gone, limit = 0.0, reach / h
    while gone < limit:
        if not (0 <= row < height and 0 <= col < width) or body.occupied[row, col] != 0:
            return gone * h
        if next_u < next_v:
            gone, next_u, col = next_u, next_u + across, col + right
        else:
            gone, next_v, row = next_v, next_v + along, row + up
    return reach
