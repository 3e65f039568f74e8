"""Joins the poses that a caller sends with those that the server has (pure)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from specshield.arrays import Bools, Floats
from specshield.errors import HistoryConflict, HistoryGap, PoseError

TOLERANCE = 1e-6  # m or rad


def join(stored: Floats, t: int, poses: Floats) -> Floats:
    """The poses to add to `stored` so that it reaches step t; none if it does already.

    stored: [n, 3], x_0 .. x_{n-1}, in [m, m, rad].  poses: [k, 3], x_{t-k+1} .. x_t.
    Poses in both have to agree within `TOLERANCE` (theta modulo 2 pi); the stored ones are kept.
    Raises HistoryGap (`expected_t`: the first pose that is missing), HistoryConflict, PoseError.
    """
    length = len(stored)
    first = t - len(poses) + 1
    if first < 0:
        raise PoseError(
            f"{len(poses)} poses cannot end at step {t}: a trajectory has {t + 1} poses up to there",
            path="poses",
            got=len(poses),
            expected=f"1 to {t + 1} poses, the last of them x_{t}",
        )
    if first > length:
        told = f"the poses begin at step {first}; the server has those before step {length}"
        raise gap(told, first, length, t)
    overlap = min(length, t + 1) - first
    if overlap == 0:
        return poses
    differs = np.flatnonzero(np.any(~agree(stored[first : first + overlap], poses[:overlap]), axis=1))
    if len(differs):
        row = int(differs[0])
        begins = ", its initial_pose" if first + row == 0 else ""
        raise HistoryConflict(
            f"the session has another pose for step {first + row} already{begins}",
            path=f"poses[{row}]",
            got=poses[row].tolist(),
            expected=f"{stored[first + row].tolist()} within {TOLERANCE:g}",
            t=first + row,
            stored=stored[first + row].tolist(),
        )
    return poses[overlap:]


def gap(told: str, got: int | None, length: int, t: int) -> HistoryGap:
    """The error for poses up to step t that leave a gap after those of the server, x_0 .. x_{length-1}."""
    expected = f"poses from step {length} or earlier up to step {t}"
    return HistoryGap(told, path="poses", got=got, expected=expected, expected_t=length)


def agree(a: Floats, b: Floats) -> Bools:
    """For each element of two arrays of poses [..., 3]: equal within `TOLERANCE`, headings modulo 2 pi."""
    difference: Any = np.abs(a - b)
    turn = np.mod(difference[..., 2], 2 * math.pi)
    difference[..., 2] = np.minimum(turn, 2 * math.pi - turn)
    return np.asarray(difference <= TOLERANCE)
