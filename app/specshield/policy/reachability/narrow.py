"""A continuation after each first motion, for rules with predicates that the lattice can hardly see.

From x_t the robot climbs the tables until they lead round in a circle, near a narrow predicate; a search in
exact poses leads on (finish.py). Where too little time is left for that, the search begins sooner on the way,
at last at x_t itself. The other first motions are undone to go the same way, or looked at in the same manner.
"""

from __future__ import annotations

import numpy as np

from specshield.arrays import Bools, Floats, Int8s, Ints
from specshield.compiled import Boxed, kernel, leaf
from specshield.policy.detour import copy_ways
from specshield.policy.progress import SETTLED
from specshield.policy.progress.recall import Past
from specshield.policy.reachability.finish import Search, finish
from specshield.policy.reachability.guide import copy_progress, fill, update_progress
from specshield.policy.reachability.search import begin, go_back, join_sibling, take
from specshield.policy.reachability.tables import (
    HOPELESS,
    Guide,
    Scratch,
    guided,
    is_broken,
    settled_goals,
    slack,
)
from specshield.policy.reachability.walk import CLIMB_GAIN, SETTLED_ALL, STUCK, climb

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
    boxed: Boxed[Guide],
    margin: float,
    narrow: Bools,
    top: Floats,
    effort: Floats,
    past: Past,
    wanted: Bools,
    lowest: float,
    motions: Ints,
    poses: Floats,
) -> int:
    """`continue_all` for a rule with narrow predicates: those of the obligations `narrow` (K,).

    margin: what the rules ask for [m]. top [tables]: the latest feasible time of each table [steps]. effort
    [searches, 4]: for the way from x_t. The other arguments are those of `continue_all`. The robot has to be
    one that can wait.
    """
    guide = guided(boxed, margin)
    starts, scratch = begin(guide, past, wanted, motions, poses)
    now, order, twin, settled = starts.now, starts.order, starts.twin, starts.settled
    if not np.any(wanted & (starts.slack >= lowest)):
        return -1
    known = np.empty(order.shape[0], np.int64)
    # The way from x_t itself, as if a motion before had led there.
    way, led, ways = np.full(motions.shape[1] + 1, -1), np.empty((motions.shape[1] + 1, 3)), 0
    led[0] = now.pose
    copy_progress(now.status, now.run, scratch.status, scratch.run)
    base = -1
    if _go(guide, narrow, top, effort, now.t - 1, way, led, scratch):
        base = twin[way[1]]
        motions[base, 1:], poses[base, 1:] = way[2:], led[2:]
        settled[base] = True
        known[0], ways = base, 1
    for m in order:
        if twin[m] != m or m == base or not wanted[m]:
            continue
        if base < 0:  # no first motion leads on, as far as the search from x_t can tell
            fill(1, guide.wait, motions[m], poses[m])
            continue
        settled[m] = join_sibling(guide, now.t, known[:ways], int(m), starts, scratch)
        if not settled[m]:
            settled[m] = go_back(guide, now.t, int(m), way[1:], led[1:], starts, scratch)
        if not settled[m]:
            copy_progress(starts.status[m], starts.run[m], scratch.status, scratch.run)
            settled[m] = _go(guide, narrow, top, AFTER, now.t, motions[m], poses[m], scratch)
            if settled[m]:
                known[ways], ways = m, ways + 1
    copy_ways(motions, poses, twin)
    return int(base if base >= 0 else order[0] if wanted[order[0]] else guide.wait)


@kernel
def _go(
    guide: Guide,
    narrow: Bools,
    top: Floats,
    effort: Floats,
    t: int,
    motions: Ints,
    poses: Floats,
    scratch: Scratch,
) -> bool:
    """Goes on from motions[:1] to the horizon; returns whether every goal was settled. For the arguments see
    `continue_narrow` and `climb`.
    """
    n = 1
    for _ in range(MAX_LEGS):
        start, status, run = n, scratch.status.copy(), scratch.run.copy()
        outcome, n = climb(guide, t, n, motions, poses, scratch, True)
        if outcome == SETTLED_ALL:
            return True
        if outcome == STUCK:
            fill(n, guide.wait, motions, poses)
        copy_progress(status, run, scratch.status, scratch.run)
        near = _nearest(guide, t, start, n, poses, scratch)
        taken, before = 0, -1
        for e in range(effort.shape[0]):
            n = max(start, near - int(effort[e, 0]))
            if n == before and effort[e, 1] == effort[e - 1, 1]:
                continue
            before = n
            copy_progress(status, run, scratch.status, scratch.run)
            for i in range(start, n):
                update_progress(guide.rules, t + i + 1, poses[i, 0], poses[i, 1], poses[i, 2], scratch)
            here, ran = scratch.status.copy(), scratch.run.copy()
            highest = _top_of(guide, top, t + n, here)
            search = Search(effort[e, 2], int(effort[e, 1]), effort[e, 3], highest)
            taken = finish(guide, narrow, search, t + n, poses[n - 1], motions[n:], scratch)
            if taken > 0:
                copy_progress(here, ran, scratch.status, scratch.run)
                break
        if taken == 0:
            return False
        n = take(guide, t, n, motions[n : n + taken], motions, poses, scratch)
    return False


@leaf
def _nearest(guide: Guide, t: int, start: int, stop: int, poses: Floats, scratch: Scratch) -> int:
    """How many motions lead to the pose with the highest latest feasible time, on the way from
    motions[:start] to motions[:stop] and after the last goal that is settled on it. The scratch holds the
    progress at its beginning.
    """
    best, found, settled = HOPELESS, start, 0
    for n in range(start, stop + 1):
        x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
        if n > start:
            update_progress(guide.rules, t + n, x, y, theta, scratch)
        if is_broken(scratch.status):
            break
        latest, now = t + n + slack(guide, x, y, theta, t + n, scratch), 0
        for k in range(scratch.status.shape[0]):
            now += scratch.status[k] == SETTLED
        if now > settled or latest > best + CLIMB_GAIN:
            best, found, settled = latest, n, now
    return found


@leaf
def _top_of(guide: Guide, top: Floats, t: int, status: Int8s) -> float:
    """The latest feasible time [steps] that any pose has at step t with this progress."""
    tables = guide.tables
    table = tables.table[tables.phase[t], settled_goals(tables, status)]
    return top[table] if table >= 0 else -np.inf
