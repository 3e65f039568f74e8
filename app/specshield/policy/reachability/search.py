"""A continuation after each first motion, out of the tables of latest feasible times.

The motion of most slack is walked out. For any other it is mostly enough to undo it and go the same way, or
to turn and go the way of one that led to the same place. Where that comes too late, or the walk gets stuck, a
beam looks for a way.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel, leaf, merged
from specshield.policy.detour import copy_way, find_sibling, find_twins
from specshield.policy.reachability.beam import EASY, MAX_ROOTS, beam
from specshield.policy.reachability.tables import HOPELESS, SAFE, goals_settled, slack
from specshield.policy.reachability.walk import SETTLED_ALL, STUCK, rejoin, walk
from specshield.policy.reachability.work import Guide, Work, fill, make_work, observe
from specshield.robot.dynamics import (
    IMPOSSIBLE,
    NOT_NEEDED,
    displacement,
    move_back,
    simulate,
    step,
    turn_by,
)
from specshield.rule.progress import forgive, recall

ESCAPE_GAIN = 2.0  # [steps] later than where it got stuck: what a way out has to reach
ESCAPE_LOSS = 6.0  # [steps] of slack that it may cost on the way
ESCAPE_DEPTH = 24
MAX_ESCAPES = 8
BAND = -3.0  # [steps] of slack: how far the tables err
ROOTS = 4  # first motions that one beam serves, where others may then go the ways it finds
NARROW = 2  # poses that the first beam of a robot that cannot wait keeps for each motion
SMALL = 30_000  # poses of a lattice on which nearly every way can be tried
SMALL_SHARE = 512


class Starts(NamedTuple):
    """After each first motion [M]: the progress, the slack, whether a way was found.

    turn, move: the motions that undo it, nearly, or NOT_NEEDED; a turn may be IMPOSSIBLE.
    sibling (3,): scratch.
    """

    status: NDArray[np.int8]
    run: NDArray[np.int64]
    slack: NDArray[np.float64]
    turn: NDArray[np.int64]
    move: NDArray[np.int64]
    settled: NDArray[np.bool_]
    sibling: NDArray[np.int64]


@kernel
def propose_all(
    guide: Guide,
    width: int,
    past: float,
    history: NDArray[np.float64],
    signals: NDArray[np.float64],
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> int:
    """history (t + 1, 3), signals (t + 1, S); width: poses a beam keeps for each motion; past: the margin
    that history is judged by.

    Writes a continuation a first motion, motions (M, T - t) and poses (M, T - t, 3); returns the motion of
    most slack. The rules' signals are left at the last row.
    """
    count, t, k_count = motions.shape[0], history.shape[0] - 1, guide.rules.kind.shape[0]
    status, run = np.empty(k_count, np.int8), np.empty(k_count, np.int64)
    recall(guide.rules, past, history, signals, status, run)
    forgive(guide.rules, t, status)
    work = make_work(guide.rules, count)
    starts = Starts(
        np.empty((count, k_count), np.int8), np.empty((count, k_count), np.int64), np.empty(count),
        np.empty(count, np.int64), np.empty(count, np.int64), np.zeros(count, np.bool_),
        np.empty(3, np.int64),
    )  # fmt: skip
    order, twin, walked = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64)
    _first_steps(guide, t, history[t], status, run, motions, poses, starts, work)
    _by_slack(starts.slack, order)
    find_twins(poses, twin)
    waits, base, ways = guide.wait >= 0, -1, 0
    for m in order:
        if twin[m] != m:
            continue
        if not waits:  # tables step by step: beams all the way
            motions[m, 1:] = m
            simulate(guide.body, poses[m, 0], motions[m, 1:], poses[m, 1:])
            starts.settled[m] = starts.slack[m] == SAFE
            continue
        turn, move, ahead = starts.turn[m], starts.move[m], starts.slack[m]
        starts.settled[m] = _join(guide, t, walked[:ways], int(m), starts, motions, poses, work)
        if base >= 0 and turn != IMPOSSIBLE and not starts.settled[m]:
            _resume(starts.status[m], starts.run[m], work)
            starts.settled[m] = rejoin(
                guide, t, turn, move, motions[base], poses[base], 0, motions[m], poses[m], work
            )
        if not starts.settled[m] and (ahead >= 0.0 or base < 0 or turn == IMPOSSIBLE):
            _resume(starts.status[m], starts.run[m], work)
            escapes = ahead >= (0.0 if base < 0 else EASY)
            starts.settled[m] = _follow(guide, width, t, 1, escapes, motions[m], poses[m], work)
            if starts.settled[m]:
                walked[ways] = m
                ways += 1
        if starts.settled[m] and base < 0:
            base = int(m)
    small = guide.tables.code.shape[1] * guide.tables.code.shape[2] <= SMALL
    for attempt in range(3):
        share, band = width, BAND if waits else 0.0
        if attempt == 0:
            share = NARROW
        elif attempt == 2:
            share, band = SMALL_SHARE, 2.0 * HOPELESS
        if (attempt > 0 or not waits) and (attempt < 2 or small):
            _beam_out(guide, t, share, width, band, order, twin, starts, motions, poses, work)
    for same in range(count):
        if twin[same] != same:
            copy_way(motions, poses, twin[same], same)
    best = order[0]
    return int(guide.wait if waits and starts.slack[guide.wait] == starts.slack[best] else best)


@leaf
def _first_steps(
    guide: Guide,
    t: int,
    pose: NDArray[np.float64],
    status: NDArray[np.int8],
    run: NDArray[np.int64],
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
    starts: Starts,
    work: Work,
) -> None:
    """Every motion from x_t. status, run: the progress there."""
    body, rules, tables, _ = guide
    for m in range(motions.shape[0]):
        x, y, theta = step(body, pose[0], pose[1], pose[2], m)
        motions[m, 0] = m
        poses[m, 0, 0], poses[m, 0, 1], poses[m, 0, 2] = x, y, theta
        starts.turn[m] = turn_by(body, -displacement(body, m)[1]) if theta != pose[2] else NOT_NEEDED
        starts.move[m] = move_back(body, m, math.hypot(x - pose[0], y - pose[1]))
        _resume(status, run, work)
        observe(rules, t + 1, x, y, theta, work)
        for k in range(status.shape[0]):
            starts.status[m, k], starts.run[m, k] = work.status[k], work.run[k]
        starts.slack[m] = slack(body, rules, tables, x, y, theta, t + 1, work.status, work.run)


@leaf
def _by_slack(slacks: NDArray[np.float64], order: NDArray[np.int64]) -> None:
    """The motions by falling slack, the lowest index first on ties."""
    for i in range(slacks.shape[0]):
        j = i
        while j > 0 and slacks[order[j - 1]] < slacks[i]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = i


@leaf
def _resume(status: NDArray[np.int8], run: NDArray[np.int64], work: Work) -> None:
    for k in range(status.shape[0]):
        work.status[k], work.run[k] = status[k], run[k]


@leaf
def _join(
    guide: Guide,
    t: int,
    known: NDArray[np.int64],
    m: int,
    starts: Starts,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
    work: Work,
) -> bool:
    """Goes the way of one of the motions `known` that led to the same place; whether that settles all."""
    found = starts.sibling
    find_sibling(guide.body, poses, known, m, True, found)
    if found[0] < 0:
        return False
    _resume(starts.status[m], starts.run[m], work)
    other = found[0]
    return rejoin(guide, t, found[1], -1, motions[other], poses[other], found[2], motions[m], poses[m], work)


@merged
def _follow(
    guide: Guide,
    width: int,
    t: int,
    n: int,
    escapes: bool,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
    work: Work,
) -> bool:
    """Walks on from motions[:n], where it gets stuck by a short beam, if that is allowed. Whether every goal
    was settled."""
    outcome, n = walk(guide, t, n, motions, poses, work)
    for _ in range(MAX_ESCAPES if escapes else 0):
        if outcome != STUCK:
            break
        status, run = work.high_status.copy(), work.high_run.copy()
        x, y, theta = poses[n - 1]
        high = t + n + slack(guide.body, guide.rules, guide.tables, x, y, theta, t + n, status, run)
        way = np.empty((1, min(motions.shape[0] - n, ESCAPE_DEPTH)), np.int64)
        taken = np.empty(1, np.int64)
        beam(
            guide, t + n, poses[n - 1 : n], status.reshape(1, -1), run.reshape(1, -1), width,
            high - (t + n) - ESCAPE_LOSS, high + ESCAPE_GAIN, work, way, taken,
        )  # fmt: skip
        if taken[0] == 0:
            break
        _resume(status, run, work)
        n = _take(guide, t, n, way[0, : taken[0]], motions, poses, work)
        outcome, n = walk(guide, t, n, motions, poses, work)
    if outcome == STUCK:
        fill(n, guide.wait, poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2], motions, poses)
    return outcome == SETTLED_ALL


@leaf
def _take(
    guide: Guide,
    t: int,
    n: int,
    way: NDArray[np.int64],
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
    work: Work,
) -> int:
    """Appends `way` to motions[:n], which work's progress belongs to; returns how many there are then."""
    x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
    for i in range(way.shape[0]):
        x, y, theta = step(guide.body, x, y, theta, way[i])
        motions[n] = way[i]
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
        n += 1
        observe(guide.rules, t + n, x, y, theta, work)
    return n


@merged
def _beam_out(
    guide: Guide,
    t: int,
    share: int,
    width: int,
    band: float,
    order: NDArray[np.int64],
    twin: NDArray[np.int64],
    starts: Starts,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
    work: Work,
) -> None:
    """Looks for a way for every first motion without one whose slack is at least `band`."""
    steps = motions.shape[1] - 1
    roots = np.array(
        [m for m in order if twin[m] == m and not starts.settled[m] and starts.slack[m] >= band],
        dtype=np.int64,
    )
    if steps == 0:
        return
    few = ROOTS if guide.wait >= 0 else MAX_ROOTS
    while roots.shape[0] > 0:
        some, rest = roots[:few], roots[few:]
        way, taken = np.empty((some.shape[0], steps), np.int64), np.empty(some.shape[0], np.int64)
        beam(
            guide, t + 1, poses[some, 0], starts.status[some], starts.run[some], share, band, np.inf, work,
            way, taken,
        )  # fmt: skip
        for i in range(some.shape[0]):
            m = some[i]
            if taken[i] > 0:
                _resume(starts.status[m], starts.run[m], work)
                n = _take(guide, t, 1, way[i, : taken[i]], motions[m], poses[m], work)
                if guide.wait >= 0:
                    starts.settled[m] = _follow(guide, width, t, n, True, motions[m], poses[m], work)
                    continue
                starts.settled[m] = goals_settled(guide.rules, work.status)
                simulate(guide.body, poses[m, n - 1], motions[m, n:], poses[m, n:])
        if guide.wait >= 0:
            known = some[starts.settled[some]]
            for m in rest:
                starts.settled[m] = _join(guide, t, known, m, starts, motions, poses, work)
        roots = rest[~starts.settled[rest]]
