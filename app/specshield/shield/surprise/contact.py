"""What a step says of the map without any sensor: what a motion ran into, and where the robot has been.

The shield knows poses, not what was executed. A pose on the way of a motion, and short of where f leads, is a
contact of that motion, unless the end of another motion explains it. Where the robot did not move at all, it
may have slipped, or its caller may have chosen to wait: so that counts only for a caller that executes what
was drawn, and only the second time in a row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.robot.dynamics import TOUCH, Body, displacement, wrap

# Chosen by hand: five times the noise of a Stretch's controller (0.01 m, 0.5 degrees; DESIGN.md, section 4).
NEAR_MOVE, NEAR_TURN = 0.05, math.radians(2.5)  # [m], [rad] poses this near may be one, but for noise
ARC = math.radians(35.0)  # [rad] to both sides of straight ahead: what a contact marks


@dataclass(frozen=True)
class Followed:
    """What is known of how the caller follows: the motion drawn last (-1: none), whether all steps so far can
    be what was drawn, and the drawn motion that did nothing in the step before (-1: none).
    """

    drawn: int = -1
    follows: bool = True
    halted: int = -1


def contact_of(
    body: Body, followed: Followed, before: Floats, after: Floats, foreseen: Floats
) -> tuple[int, Followed]:
    """The motion that stopped short between two poses (3,), -1 for none, and what is known of the caller now.

    foreseen [M, 3]: where f leads from `before`.
    """
    drawn = followed.drawn
    if drawn >= 0 and _near(foreseen[drawn : drawn + 1], after)[0]:
        return -1, followed if followed.halted < 0 else replace(followed, halted=-1)
    near = _near(foreseen, after)
    if _near(before[None], after)[0]:  # it stands where it stood
        if drawn < 0 or not followed.follows:
            return -1, followed
        again = followed.halted == drawn
        return (drawn, replace(followed, halted=-1)) if again else (-1, replace(followed, halted=drawn))
    if near.any():
        return -1, replace(followed, follows=False, halted=-1)
    short = _short(body, before, after, foreseen)
    if drawn >= 0 and short[drawn]:
        return drawn, replace(followed, halted=-1)
    return int(np.argmax(short)) if short.any() else -1, replace(followed, halted=-1)


def _near(poses: Floats, pose: Floats) -> Bools:
    """Which of poses [n, 3] are the pose (3,), but for noise."""
    turn = np.abs(np.remainder(poses[:, 2] - pose[2] + math.pi, 2.0 * math.pi) - math.pi)
    near: Bools = (np.hypot(*(poses[:, :2] - pose[:2]).T) <= NEAR_MOVE) & (turn <= NEAR_TURN)
    return near


def _short(body: Body, before: Floats, after: Floats, foreseen: Floats) -> Bools:
    """Which motions [M] lead straight through `after` and on."""
    cos, sin = math.cos(before[2]), math.sin(before[2])
    dx, dy = after[:2] - before[:2]
    ahead, aside = dx * cos + dy * sin, dy * cos - dx * sin
    found = np.zeros(len(foreseen), np.bool_)
    if abs(aside) > NEAR_MOVE or abs(wrap(after[2] - before[2])) > NEAR_TURN:
        return found
    for motion in range(len(foreseen)):
        far, _ = displacement(body, motion)
        reached = math.hypot(*(foreseen[motion, :2] - before[:2]))
        found[motion] = far * ahead > 0.0 and abs(ahead) < reached - NEAR_MOVE
    return found


def cells_ahead(body: Body, pose: Floats, motion: int) -> Ints:
    """The cells, ascending, that begin within a cell's side of the footprint where a motion leads from a pose
    (3,): straight ahead, or for a turn the way that the footprint's centre swings.
    """
    far, turn = displacement(body, motion)
    direction = pose[2] + (0.0 if far > 0.0 else math.pi)
    if far == 0.0:
        direction = pose[2] + math.atan2(body.offset_y, body.offset_x) + math.copysign(0.5 * math.pi, turn)
    cells, gap, bearing = _around(body, pose)
    aside = np.abs(np.remainder(bearing - direction + math.pi, 2.0 * math.pi) - math.pi)
    touched: Ints = cells[(gap > -TOUCH) & (gap <= body.resolution) & (aside <= ARC)]
    return touched


def cells_under(body: Body, pose: Floats, deep: float) -> Ints:
    """The cells, ascending, that the footprint at a pose (3,) covers by more than `deep` [m]."""
    cells, gap, _ = _around(body, pose)
    under: Ints = cells[gap < -deep]
    return under


def _around(body: Body, pose: Floats) -> tuple[Ints, Floats, Floats]:
    """The cells about the footprint, how far each is from it [m], and in which direction from its centre."""
    x, y, theta = pose
    c, s, h = math.cos(theta), math.sin(theta), body.resolution
    dx = x + body.offset_x * c - body.offset_y * s - body.origin_x
    dy = y + body.offset_x * s + body.offset_y * c - body.origin_y
    u, v = body.cos_yaw * dx + body.sin_yaw * dy, body.cos_yaw * dy - body.sin_yaw * dx
    reach = body.radius + 2.0 * h
    height, width = body.occupied.shape
    rows = np.arange(max(math.floor((v - reach) / h), 0), min(math.floor((v + reach) / h) + 1, height))
    columns = np.arange(max(math.floor((u - reach) / h), 0), min(math.floor((u + reach) / h) + 1, width))
    row, column = (each.ravel() for each in np.meshgrid(rows, columns, indexing="ij"))
    du = np.maximum(np.maximum(column * h - u, u - (column + 1) * h), 0.0)
    dv = np.maximum(np.maximum(row * h - v, v - (row + 1) * h), 0.0)
    yaw = math.atan2(body.sin_yaw, body.cos_yaw)
    bearing = np.arctan2((row + 0.5) * h - v, (column + 0.5) * h - u) + yaw
    return row * width + column, np.hypot(du, dv) - body.radius, bearing
