"""The last steps to a narrow predicate, in exact poses: best first, by what the tables leave to spare.

The tables lead to about where a narrow predicate holds (sight.py), not to where it does. From there on every
pose that the robot's motions can reach is tried, those with the most slack first, until the predicate itself
holds. Poses count once where they are nearly the same. Headings are not rounded to anything: a robot that
turns by 30 and by 6 degrees has those that are a multiple of 6 degrees from its own, and no other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Int8s, Ints
from specshield.compiled import inlined, kernel
from specshield.policy.progress import ALWAYS, PENDING, SETTLED, Rules
from specshield.policy.reachability.guide import copy_progress, due, predicate_at, update_progress
from specshield.policy.reachability.tables import UNKNOWN, Guide, Scratch, is_broken, slack_at
from specshield.policy.tree import DEGREE, Grain, enter, make_tree, pop, push, put, trace
from specshield.robot.dynamics import around, motion_count, step_from

# Chosen by hand; python -m benchmarks.narrow measures what they find.
NEAR = 6.0  # [steps] from where the slack is highest: nearer than this, poses are told apart by the grain
FAR_GRAIN = 0.1  # [m] farther off, by this


class Search(NamedTuple):
    """What one search is allowed. grain: poses that differ by less [m] count once; most: poses that it makes;
    band: the least slack [steps] that they may have, by so much the tables may err; top: the latest feasible
    time [steps] that they can have.
    """

    grain: float
    most: int
    band: float
    top: float


@kernel
def finish(
    guide: Guide, narrow: Bools, search: Search, t: int, pose: Floats, way: Ints, scratch: Scratch
) -> int:
    """Writes a way from x_t on to where one more narrow predicate is kept, into way (n,); its length, 0 for
    none. The robot has to be one that can wait.

    pose (3,): x_t; the scratch holds the progress there. narrow (K,): the obligations that it is about.
    """
    body, rules = guide.body, guide.rules
    k_count, most = scratch.status.shape[0], search.most
    goal, some = np.zeros(k_count, np.bool_), False
    for k in range(k_count):
        open_now = rules.kind[k] != ALWAYS or rules.a[k] > t
        if narrow[k] and scratch.status[k] == PENDING and open_now:
            goal[k] = predicate_at(rules, k, pose[0], pose[1], pose[2], scratch) <= rules.margin
            some = some or goal[k]
    if not some:
        return 0
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
            if left < search.band:
                continue
            put(tree, count, x, y, theta, made + 1, here, m)
            copy_progress(scratch.status, scratch.run, tree.status[count], tree.run[count])
            grain = search.grain if left + now > search.top - NEAR else FAR_GRAIN
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
