"""From a first motion onto a way that is known: by undoing it, or from the same place as another's.

Near a wall many motions end in the same pose; arcs of one length end in the same place, turned differently.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import leaf
from specshield.robot.dynamics import IMPOSSIBLE, Body, turn_by, wrap


@leaf
def find_twins(poses: NDArray[np.float64], twin: NDArray[np.int64]) -> None:
    """The first motion that ends in the very same pose, often itself, of each. poses (M, n, 3), twin (M,)."""
    for m in range(poses.shape[0]):
        twin[m] = 0
        while twin[m] < m and not _same(poses, twin[m], m):
            twin[m] += 1


@leaf
def _same(poses: NDArray[np.float64], a: int, b: int) -> bool:
    same = True
    for i in range(3):
        same = same and poses[a, 0, i] == poses[b, 0, i]
    return same


@leaf
def copy_way(motions: NDArray[np.int64], poses: NDArray[np.float64], source: int, target: int) -> None:
    """What follows one first motion becomes what follows another. motions (M, n), poses (M, n, 3)."""
    for i in range(1, motions.shape[1]):
        motions[target, i] = motions[source, i]
        for k in range(3):
            poses[target, i, k] = poses[source, i, k]


@leaf
def find_sibling(
    body: Body,
    poses: NDArray[np.float64],
    known: NDArray[np.int64],
    motion: int,
    waits: bool,
    out: NDArray[np.int64],
) -> None:
    """How to come onto the way of one of the motions `known` that ends where `motion` does. out (3,): that
    motion, -1 where there is none; the turn to make, -1 where the heading fits; after how many motions of
    its way the robot is then on it: where that begins by turning, the turns are made at once. A robot that
    cannot wait (`waits`) has to come onto it no sooner than the other.

    poses (M, n, 3): after each motion first.
    """
    out[0] = -1
    for k in range(known.shape[0]):
        other, j = known[k], 0
        while j < poses.shape[1] and poses[other, j, 0] == poses[motion, 0, 0]:
            moved = poses[other, j, 1] != poses[motion, 0, 1]
            if moved or (j > 0 and poses[other, j, 2] == poses[other, j - 1, 2]):
                break
            turn = turn_by(body, wrap(poses[other, j, 2] - poses[motion, 0, 2]))
            j += 1
            if turn != IMPOSSIBLE and (out[0] < 0 or j > out[2]) and (waits or j <= 1 + (turn >= 0)):
                out[0], out[1], out[2] = other, turn, j


@leaf
def join(
    turn: int, move: int, base: NDArray[np.int64], at: int, wait: int, motions: NDArray[np.int64]
) -> None:
    """Writes what follows motions[0] (T - t,): `turn` and `move` (-1: none is needed), which lead to where
    `base` (T - t,) is after its first `at` motions, then the rest of `base`.

    The steps lost are made up for where `base` waits, those gained are waited for. wait: -1 for a robot that
    cannot, which may not gain any.
    """
    n, steps, behind = 1, motions.shape[0], 1 - at
    for extra in (turn, move):
        if extra >= 0 and n < steps:
            motions[n] = extra
            n += 1
            behind += 1
    while n < steps:
        while behind > 0 and at < steps and base[at] == wait:
            at += 1
            behind -= 1
        if behind < 0:
            motions[n] = wait
            behind += 1
        else:
            motions[n] = base[at] if at < steps else wait
            at += 1
        n += 1
