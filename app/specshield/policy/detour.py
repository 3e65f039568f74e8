"""How a first motion can join a way that is already known: by undoing the motion, or because another motion
led to the same place.

Near a wall many motions end in the same pose. Arcs of one length end in the same place, with other headings.
"""

from __future__ import annotations

from specshield.arrays import Floats, Ints, copy_row
from specshield.compiled import leaf
from specshield.policy.undo import IMPOSSIBLE, turn_by
from specshield.robot.dynamics import Body, wrap


@leaf
def find_twins(poses: Floats, twin: Ints) -> None:
    """For each motion, the first one that ends in the same pose, or itself. poses (M, n, 3), twin (M,)."""
    for m in range(poses.shape[0]):
        twin[m] = 0
        while twin[m] < m and not is_same_pose(poses[twin[m], 0], poses[m, 0]):
            twin[m] += 1


@leaf
def is_same_pose(pose: Floats, other: Floats) -> bool:
    """Whether two poses (3,) are the same to the last bit."""
    return bool(pose[0] == other[0] and pose[1] == other[1] and pose[2] == other[2])


@leaf
def copy_ways(motions: Ints, poses: Floats, twin: Ints) -> None:
    """Copies to each motion what follows its twin (M,). motions (M, n), poses (M, n, 3)."""
    for m in range(twin.shape[0]):
        if twin[m] != m:
            copy_row(motions[twin[m], 1:], motions[m, 1:])
            for i in range(1, motions.shape[1]):
                copy_row(poses[twin[m], i], poses[m, i])


@leaf
def find_sibling(body: Body, poses: Floats, known: Ints, motion: int, waits: bool, out: Ints) -> None:
    """How to join the way of one of the motions `known`, which ends at the place where `motion` does.

    Writes into out (3,): that other motion, -1 for none; the turn to make, NOT_NEEDED if the heading fits;
    and after how many motions of its way the robot joins it. If that way begins with turns, one turn replaces
    them. A robot that cannot wait (`waits` is false) may not be ahead of the way that it joins. poses (M, n,
    3): of each motion's way.
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
def join(turn: int, move: int, base: Ints, at: int, wait: int, motions: Ints) -> None:
    """Writes what follows the first of motions (T - t,): `turn` and `move` (or NOT_NEEDED), which lead to
    where `base` (T - t,) is after its first `at` motions, then the rest of `base`.

    A robot that is late leaves out waits of `base`; one that is early waits. wait: the motion that waits, -1
    for a robot that cannot, which may not be early.
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
