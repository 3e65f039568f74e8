"""Barred motions: they led nowhere from some poses, whatever f says.

Each is a row: x, y, theta, motion, and how near another pose has to be to count as the same, [m] and [rad].
"""

from __future__ import annotations

import math

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.compiled import kernel, leaf
from specshield.robot.dynamics import wrap

NOTHING_BARRED = np.empty((0, 6))


@leaf
def is_barred(barred: Floats, x: float, y: float, theta: float, motion: int) -> bool:
    """Whether a motion led nowhere from a pose. barred [n, 6]."""
    for i in range(barred.shape[0]):
        if (
            barred[i, 3] == motion
            and math.hypot(barred[i, 0] - x, barred[i, 1] - y) <= barred[i, 4]
            and abs(wrap(barred[i, 2] - theta)) <= barred[i, 5]
        ):
            return True
    return False


@kernel
def in_vain(barred: Floats, pose: Floats, motions: Ints, poses: Floats, whole: bool) -> Bools:
    """Which futures from a pose (3,) make a barred motion. Shape [N].

    motions [N, L], poses [N, L, 3]: the futures, and where they lead. whole: look at every step; else only
    at the steps before the robot first moves. barred [n, 6].
    """
    found = np.zeros(motions.shape[0], np.bool_)
    for i in range(motions.shape[0]):
        x, y, theta = pose[0], pose[1], pose[2]
        for k in range(motions.shape[1]):
            if is_barred(barred, x, y, theta, motions[i, k]):
                found[i] = True
                break
            nx, ny, nth = poses[i, k, 0], poses[i, k, 1], poses[i, k, 2]
            if not (whole or (nx == x and ny == y and nth == theta)):
                break
            x, y, theta = nx, ny, nth
    return found
