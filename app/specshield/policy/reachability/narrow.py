"""A continuation after each first motion, for rules with predicates that the lattice can hardly see.

From x_t the robot climbs the tables until they lead round in a circle, near a narrow predicate; a search in
exact poses leads on (finish.py). Where too little time is left for that, the search begins sooner on the way,
at last at x_t itself. The other first motions are undone to go the same way, or looked at in the same manner.
"""

from __future__ import annotations

import numpy as np

from specshield.arrays import Bools, Floats, Int8s, Ints
from specshield.compiled import kernel, leaf
from specshield.policy.detour import copy_way, find_twins
from specshield.policy.progress import SETTLED
from specshield.policy.progress.recall import forgive, recall
from specshield.policy.reachability.finish import Search, finish
from specshield.policy.reachability.guide import (
    Guide,
    Scratch,
    copy_progress,
    fill,
    make_scratch,
    update_progress,
)
from specshield.policy.reachability.search import Starts, _by_slack, _first_steps, _join, _some_in_time, _take
from specshield.policy.reachability.tables import HOPELESS, is_broken, slack
from specshield.policy.reachability.walk import CLIMB_GAIN, SETTLED_ALL, STUCK, climb, rejoin
from specshield.policy.undo import IMPOSSIBLE

# Searches for one way, each tried where those before it failed. Columns: how many steps before the robot is
# near it begins, how many poses it makes, what they are told apart by [m], and the least slack that they may
# have [steps]. FIRST: at a session's first step; ON: from x_t later on; AFTER: after a first motion that
# cannot be undone in time. Chosen by hand; python -m benchmarks.narrow measures what they find.
FIRST = np.array(
    [[0, 20_000, 0.02, -3], [8, 60_000, 0.02, -3], [20, 150_000, 0.02, -3], [1000, 200_000, 0.02, -6]]
)
ON = np.array([[0, 20_000, 0.02, -3], [6, 40_000, 0.02, -3]])
AFTER = np.array([[0, 5_000, 0.02, -3], [6, 10_000, 0.02, -3]])
MAX_LEGS = 16  # searches on one way


@kernel
def continue_narrow(
    guide: Guide, narrow: Bools, top: Floats, effort: Floats, past: float, history: Floats, signals: Floats,
    wanted: Bools, lowest: float, motions: Ints, poses: Floats,
) -> int:  # fmt: skip
    """`continue_all` for a rule with narrow predicates: those of the obligations `narrow` (K,).

    top [tables]: the latest feasible time of each table [steps]. effort [searches, 4]: for the way from x_t.
    The other arguments are those of `continue_all`. The robot has to be one that can wait.
    """
    count, t, k_count = motions.shape[0], history.shape[0] - 1, guide.rules.kind.shape[0]
    status, run = np.empty(k_count, np.int8), np.empty(k_count, np.int64)
    recall(guide.rules, past, history, signals, status, run)
    forgive(guide.rules, t, status)
    scratch = make_scratch(guide.rules, count)
    starts = Starts(
        np.empty((count, k_count), np.int8), np.empty((count, k_count), np.int64), np.empty(count),
        np.empty(count, np.int64), np.empty(count, np.int64), np.zeros(count, np.bool_),
        np.empty(3, np.int64),
    )  # fmt: skip
    order, twin, known = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64)
    _first_steps(guide, t, history[t], status, run, motions, poses, starts, scratch)
    _by_slack(starts.slack, order)
    find_twins(poses, twin)
    if not _some_in_time(wanted, twin, starts.slack, lowest):
        return -1
    # The way from x_t itself, as if a motion before had led there.
    way, led, ways = np.full(motions.shape[1] + 1, -1), np.empty((motions.shape[1] + 1, 3)), 0
    led[0] = history[t]
    copy_progress(status, run, scratch.status, scratch.run)
    base = -1
    if _go(guide, narrow, top, effort, t - 1, 1, way, led, scratch):
        base = twin[way[1]]
        motions[base, 1:], poses[base, 1:] = way[2:], led[2:]
        starts.settled[base] = True
        known[0], ways = base, 1
    for m in order:
        if twin[m] != m or m == base or not wanted[m]:
            continue
        copy_progress(starts.status[m], starts.run[m], scratch.status, scratch.run)
        if base < 0:  # no first motion leads on, as far as the search from x_t can tell
            fill(1, guide.wait, poses[m, 0, 0], poses[m, 0, 1], poses[m, 0, 2], motions[m], poses[m])
            continue
        starts.settled[m] = _join(guide, t, known[:ways], int(m), starts, motions, poses, scratch)
        if starts.turn[m] != IMPOSSIBLE and not starts.settled[m]:
            copy_progress(starts.status[m], starts.run[m], scratch.status, scratch.run)
            starts.settled[m] = rejoin(
                guide, t, starts.turn[m], starts.move[m], way[1:], led[1:], 0, motions[m], poses[m], scratch
            )
        if not starts.settled[m]:
            copy_progress(starts.status[m], starts.run[m], scratch.status, scratch.run)
            starts.settled[m] = _go(guide, narrow, top, AFTER, t, 1, motions[m], poses[m], scratch)
            if starts.settled[m]:
                known[ways], ways = m, ways + 1
    for same in range(count):
        if twin[same] != same:
            copy_way(motions, poses, twin[same], same)
    return int(base if base >= 0 else order[0])


@kernel
def _go(
    guide: Guide, narrow: Bools, top: Floats, effort: Floats, t: int, n: int, motions: Ints, poses: Floats,
    scratch: Scratch,
) -> bool:  # fmt: skip
    """Goes on from motions[:n], n >= 1, to the horizon; whether every goal was settled. The arguments are
    those of `climb`.
    """
    k_count, begin = scratch.status.shape[0], n
    status, run = np.empty(k_count, np.int8), np.empty(k_count, np.int64)
    for _ in range(MAX_LEGS):
        begin = n
        copy_progress(scratch.status, scratch.run, status, run)
        outcome, n = climb(guide, t, n, motions, poses, scratch, True)
        if outcome == SETTLED_ALL:
            return True
        if outcome == STUCK:
            fill(n, guide.wait, poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2], motions, poses)
        near = _nearest(guide, t, begin, n, status, run, motions, poses, scratch)
        taken, before = 0, -1
        for e in range(effort.shape[0]):
            n = max(begin, near - int(effort[e, 0]))
            if n == before and effort[e, 1] == effort[e - 1, 1]:
                continue
            before = n
            copy_progress(status, run, scratch.status, scratch.run)
            for i in range(begin, n):
                update_progress(guide.rules, t + i + 1, poses[i, 0], poses[i, 1], poses[i, 2], scratch)
            here, ran = scratch.status.copy(), scratch.run.copy()
            highest = _top_of(guide, top, t + n, here)
            search = Search(effort[e, 2], int(effort[e, 1]), effort[e, 3], highest)
            taken = finish(guide, narrow, search, t + n, poses[n - 1], here, ran, motions[n:], scratch)
            if taken > 0:
                copy_progress(here, ran, scratch.status, scratch.run)
                break
        if taken == 0:
            return False
        n = _take(guide, t, n, motions[n : n + taken], motions, poses, scratch)
    return False


@leaf
def _nearest(
    guide: Guide, t: int, begin: int, stop: int, status: Int8s, run: Ints, motions: Ints, poses: Floats,
    scratch: Scratch,
) -> int:  # fmt: skip
    """How many motions lead to where the latest feasible time is highest on the way from motions[:begin] to
    motions[:stop], after the last goal that is settled there. status, run (K,): at its beginning.
    """
    body, rules, tables, _, _ = guide
    copy_progress(status, run, scratch.status, scratch.run)
    best, found, settled = HOPELESS, begin, 0
    for n in range(begin, stop + 1):
        if n > begin:
            update_progress(rules, t + n, poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2], scratch)
        if is_broken(scratch.status):
            break
        x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
        latest = (
            t
            + n
            + slack(body, rules, tables, x, y, theta, t + n, scratch.status, scratch.run, scratch.corners)
        )
        now = 0
        for k in range(scratch.status.shape[0]):
            now += scratch.status[k] == SETTLED
        if now > settled or latest > best + CLIMB_GAIN:
            best, found, settled = latest, n, now
    return found


@leaf
def _top_of(guide: Guide, top: Floats, t: int, status: Int8s) -> float:
    """The latest feasible time [steps] that any pose has at step t with this progress."""
    tables, mask = guide.tables, 0
    for k in range(status.shape[0]):
        if status[k] == SETTLED:
            mask |= tables.bit[k]
    table = tables.table[tables.phase[t], mask]
    return top[table] if table >= 0 else -np.inf
