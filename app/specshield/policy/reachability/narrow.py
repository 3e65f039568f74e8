"""A continuation after each first motion, for rules with predicates that the lattice can hardly see.

The tables lead to about where a narrow predicate holds (sight.py), not to where it does. From x_t the robot
climbs them until they lead round in a circle. From there on every pose that the robot's motions can reach is
tried, those with the most slack first, until the predicate itself holds. Poses count once where they are
nearly the same. Headings are not rounded to anything: a robot that turns by 30 and by 6 degrees has those
that are a multiple of 6 degrees from its own, and no other. Where too little time is left for that, the
search begins sooner on the way, at last at x_t itself. The other first motions are undone to go the same way,
or looked at in the same manner.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Int8s, Ints
from specshield.compiled import Boxed, inlined, kernel, leaf
from specshield.policy.detour import copy_ways
from specshield.policy.progress import ALWAYS, PENDING, SETTLED, Past, Rules
from specshield.policy.reachability.guide import copy_progress, due, fill, predicate_at, update_progress
from specshield.policy.reachability.search import begin, go_back, join_sibling, take
from specshield.policy.reachability.tables import (
    HOPELESS,
    UNKNOWN,
    Guide,
    Scratch,
    guided,
    is_broken,
    settled_goals,
    slack,
    slack_at,
)
from specshield.policy.reachability.walk import CLIMB_GAIN, SETTLED_ALL, STUCK, climb
from specshield.policy.tree import DEGREE, Grain, enter, make_tree, pop, push, put, trace
from specshield.robot.dynamics import around, motion_count, step_from

# Searches for one way, each tried where those before it failed. Columns: how many steps before the robot is
# near it begins, how many poses it makes, and the least slack that they may have [steps]: by so much the
# tables may err. Chosen by hand; python -m benchmarks.narrow measures what they find.
SEARCHES = np.array(
    [
        [0, 20_000, -3],
        [8, 60_000, -3],
        [20, 150_000, -3],
        [1000, 200_000, -6],
        [0, 20_000, -3],
        [6, 40_000, -3],
        [0, 5_000, -3],
        [6, 10_000, -3],
    ]
)
# The rows of these: at a session's first step, from x_t later on, and after a first motion that cannot be
# undone in time.
FIRST, ON, AFTER = (0, 4), (4, 6), (6, 8)
MAX_LEGS = 16  # searches on one way
GRAIN = 0.02  # [m] poses that differ by less, and by less than a degree, count once. By hand, as what follows
NEAR = 6.0  # [steps] from where the slack is highest: nearer than this, poses are told apart by the grain
FAR_GRAIN = 0.1  # [m] farther off, by this


class Narrow(NamedTuple):
    """What is narrow about a rule. goal [K]: the obligations whose predicate is. top [tables]: the latest
    feasible time of each table [steps].
    """

    goal: Bools
    top: Floats


@kernel
def continue_narrow(
    boxed: Boxed[Guide],
    margin: float,
    narrow: Narrow,
    effort: tuple[int, int],
    past: Past,
    wanted: Bools,
    lowest: float,
    motions: Ints,
    poses: Floats,
) -> int:
    """`continue_all` for a rule with narrow predicates.

    margin: what the rules ask for [m]. effort: the rows of SEARCHES for the way from x_t. The other arguments
    are those of `continue_all`. The robot has to be one that can wait.
    """
    guide = guided(boxed, margin)
    starts = begin(guide, past, wanted, motions, poses)
    now, scratch, order, twin, settled = starts.now, starts.scratch, starts.order, starts.twin, starts.settled
    if not np.any(wanted & (starts.slack >= lowest)):
        return -1
    known = np.empty(order.shape[0], np.int64)
    # The way from x_t itself, as if a motion before had led there.
    way, led, ways = np.full(motions.shape[1] + 1, -1), np.empty((motions.shape[1] + 1, 3)), 0
    led[0] = now.pose
    copy_progress(now.status, now.run, scratch.status, scratch.run)
    base = -1
    if _go(guide, narrow, effort, now.t - 1, way, led, scratch):
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
        settled[m] = join_sibling(guide, known[:ways], int(m), starts)
        if not settled[m]:
            settled[m] = go_back(guide, int(m), way[1:], led[1:], starts)
        if not settled[m]:
            copy_progress(starts.status[m], starts.run[m], scratch.status, scratch.run)
            settled[m] = _go(guide, narrow, AFTER, now.t, motions[m], poses[m], scratch)
            if settled[m]:
                known[ways], ways = m, ways + 1
    copy_ways(motions, poses, twin)
    return int(base if base >= 0 else order[0] if wanted[order[0]] else guide.wait)


@kernel
def _go(
    guide: Guide,
    narrow: Narrow,
    effort: tuple[int, int],
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
        taken, before = 0, (-1, -1)
        for e in range(effort[0], effort[1]):
            most, least = int(SEARCHES[e, 1]), float(SEARCHES[e, 2])
            n = max(start, near - int(SEARCHES[e, 0]))
            if (n, most) == before:
                continue
            before = n, most
            copy_progress(status, run, scratch.status, scratch.run)
            for i in range(start, n):
                update_progress(guide.rules, t + i + 1, poses[i, 0], poses[i, 1], poses[i, 2], scratch)
            here, ran = scratch.status.copy(), scratch.run.copy()
            taken = _finish(guide, narrow, most, least, t + n, poses[n - 1], motions[n:], scratch)
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


@kernel
def _finish(
    guide: Guide, narrow: Narrow, most: int, least: float, t: int, pose: Floats, way: Ints, scratch: Scratch
) -> int:
    """Writes a way from x_t on to where one more narrow predicate is kept, into way (n,); its length, 0 for
    none.

    most: how many poses are made; least: the slack [steps] that they may have at least. pose (3,): x_t; the
    scratch holds the progress there.
    """
    body, rules, tables = guide.body, guide.rules, guide.tables
    k_count = scratch.status.shape[0]
    goal, some = np.zeros(k_count, np.bool_), False
    for k in range(k_count):
        open_now = rules.kind[k] != ALWAYS or rules.a[k] > t
        if narrow.goal[k] and scratch.status[k] == PENDING and open_now:
            goal[k] = predicate_at(rules, k, pose[0], pose[1], pose[2], scratch) <= rules.margin
            some = some or goal[k]
    if not some:
        return 0
    table = tables.table[tables.phase[t], settled_goals(tables, scratch.status)]
    top = narrow.top[table] if table >= 0 else -np.inf
    tree = make_tree(most, k_count)
    put(tree, 0, pose[0], pose[1], pose[2], 0, -1, -1)
    copy_progress(scratch.status, scratch.run, tree.status[0], tree.run[0])
    count, size = 1, push(tree.heap, 0, 0, 0.0)  # the most slack first
    while size > 0 and count + motion_count(body) <= most:
        here = tree.heap.row[0]
        size = pop(tree.heap, size)
        made = tree.made[here]
        if made >= way.shape[0]:
            continue
        now = t + made + 1
        x0, y0, theta0 = tree.pose[here, 0], tree.pose[here, 1], tree.pose[here, 2]
        cos, sin, room = around(body, x0, y0, theta0)
        for m in range(motion_count(body)):
            x, y, theta = step_from(body, x0, y0, theta0, cos, sin, room, m)
            if x == x0 and y == y0 and theta == theta0:
                continue
            copy_progress(tree.status[here], tree.run[here], scratch.status, scratch.run)
            update_progress(rules, now, x, y, theta, scratch)
            if is_broken(scratch.status):
                continue
            left = slack_at(guide, x, y, theta, now, scratch, scratch.corners, UNKNOWN)
            if left < least:
                continue
            put(tree, count, x, y, theta, made + 1, here, m)
            copy_progress(scratch.status, scratch.run, tree.status[count], tree.run[count])
            grain = GRAIN if left + now > top - NEAR else FAR_GRAIN
            if enter(tree, count, Grain(1.0, grain, DEGREE), False) < 0:
                continue
            if _serves(rules, goal, now, x, y, theta, tree.status[0], scratch):
                trace(tree, count, way)
                return int(made + 1)
            size = push(tree.heap, size, count, -left)
            count += 1
    return 0


@inlined
def _serves(
    rules: Rules, goal: Bools, t: int, x: float, y: float, theta: float, before: Int8s, scratch: Scratch
) -> bool:
    """Whether a pose at step t settles one of the goals (K,), or is where a robot can wait until it does."""
    for k in range(goal.shape[0]):
        if not goal[k]:
            continue
        if scratch.status[k] == SETTLED and before[k] == PENDING:
            return True
        by = rules.a[k] if rules.kind[k] == ALWAYS else due(rules, k)
        if t <= by and predicate_at(rules, k, x, y, theta, scratch) > rules.margin:
            return True
    return False
