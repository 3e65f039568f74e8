"""The last steps to a narrow predicate, in exact poses: best first, by what the tables leave to spare.

The tables lead to about where a narrow predicate holds (sight.py), not to where it does. From there on every
pose that the robot's motions can reach is tried, those with the most slack first, until the predicate itself
holds. Poses count once where they are nearly the same. Headings are not rounded to anything: a robot that
turns by 30 and by 6 degrees has those that are a multiple of 6 degrees from its own, and no other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Int8s, Int32s, Ints
from specshield.compiled import kernel, leaf
from specshield.policy.heap import Heap, pop, push
from specshield.policy.progress import ALWAYS, EVENTUALLY, EVENTUALLY_ALWAYS, PENDING, SETTLED, Rules, advance
from specshield.policy.reachability.guide import Guide, Scratch, copy_progress, predicate_at, read_due
from specshield.policy.reachability.tables import is_broken, slack
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


class Nodes(NamedTuple):
    """Poses [N] with their progress, the steps made so far, and the motion and the pose that led to each."""

    pose: Floats
    status: Int8s
    run: Ints
    made: Int32s
    parent: Int32s
    motion: Int32s


@kernel
def finish(
    guide: Guide, narrow: Bools, search: Search, t: int, pose: Floats, status: Int8s, run: Ints, way: Ints,
    scratch: Scratch,
) -> int:  # fmt: skip
    """Writes a way from x_t on to where one more narrow predicate is kept, into way (n,); its length, 0 for
    none.

    pose (3,), status, run (K,): at x_t. narrow (K,): the obligations that it is about.
    """
    body, rules, tables, wait, _ = guide
    k_count, most = status.shape[0], search.most
    goal, some = np.zeros(k_count, np.bool_), False
    for k in range(k_count):
        open_now = rules.kind[k] != ALWAYS or rules.a[k] > t
        if narrow[k] and status[k] == PENDING and open_now:
            there = predicate_at(rules, k, pose[0], pose[1], pose[2], scratch) > rules.margin
            goal[k] = not there or wait < 0
            some = some or goal[k]
    if not some:
        return 0
    nodes = Nodes(
        np.empty((most, 3)), np.empty((most, k_count), np.int8), np.empty((most, k_count), np.int64),
        np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most, np.int32),
    )  # fmt: skip
    queue = Heap(np.empty(most, np.int32), np.empty(most))  # the most slack first
    slots = 4
    while slots < 2 * most:
        slots *= 2
    table = np.full(slots, -1, np.int32)
    nodes.pose[0], nodes.status[0], nodes.run[0] = pose, status, run
    nodes.made[0], nodes.parent[0], nodes.motion[0] = 0, -1, -1
    count, size = 1, push(queue, 0, 0, 0.0)
    while size > 0 and count + motion_count(body) <= most:
        here = queue.row[0]
        size = pop(queue, size)
        made = nodes.made[here]
        if made >= way.shape[0]:
            continue
        now = t + made + 1
        x0, y0, theta0 = nodes.pose[here, 0], nodes.pose[here, 1], nodes.pose[here, 2]
        cos, sin, room = around(body, x0, y0, theta0)
        for m in range(motion_count(body)):
            x, y, theta = step_from(body, x0, y0, theta0, cos, sin, room, m)
            if m == wait or (x == x0 and y == y0 and theta == theta0 and wait >= 0):
                continue
            copy_progress(nodes.status[here], nodes.run[here], scratch.status, scratch.run)
            read_due(rules, now, x, y, theta, scratch)
            advance(rules, now, scratch.predicates, scratch.status, scratch.run)
            if is_broken(scratch.status):
                continue
            left = slack(body, rules, tables, x, y, theta, now, scratch.status, scratch.run, scratch.corners)
            if left < search.band:
                continue
            nodes.pose[count, 0], nodes.pose[count, 1], nodes.pose[count, 2] = x, y, theta
            copy_progress(scratch.status, scratch.run, nodes.status[count], nodes.run[count])
            grain = search.grain if left + now > search.top - NEAR else FAR_GRAIN
            if not _is_new(nodes, count, grain, table):
                continue
            nodes.made[count], nodes.parent[count], nodes.motion[count] = made + 1, here, m
            if _serves(rules, goal, wait, now, x, y, theta, status, scratch):
                _trace(nodes, count, way)
                return int(made + 1)
            size = push(queue, size, count, -left)
            count += 1
    return 0


@leaf
def _serves(
    rules: Rules, goal: Bools, wait: int, t: int, x: float, y: float, theta: float, before: Int8s,
    scratch: Scratch,
) -> bool:  # fmt: skip
    """Whether a pose at step t settles one of the goals (K,), or is where a robot can wait until it does."""
    for k in range(goal.shape[0]):
        if not goal[k]:
            continue
        if scratch.status[k] == SETTLED and before[k] == PENDING:
            return True
        by = rules.b[k] if rules.kind[k] == EVENTUALLY else rules.a[k]
        if rules.kind[k] == EVENTUALLY_ALWAYS:
            by = rules.c1[k] + rules.c2[k]
        if wait >= 0 and t <= by and predicate_at(rules, k, x, y, theta, scratch) > rules.margin:
            return True
    return False


@leaf
def _is_new(nodes: Nodes, row: int, grain: float, table: Int32s) -> bool:
    """Whether no node before `row` has nearly its pose and its progress; then it is put into the hash table.

    Only nodes of one grain are compared. Headings are told apart to a degree.
    """
    x, y, h = math.floor(nodes.pose[row, 0] / grain), math.floor(nodes.pose[row, 1] / grain), 0
    h = math.floor(math.degrees(nodes.pose[row, 2]) + 0.5)
    key = x * 73856093 ^ y * 19349663 ^ h * 83492791
    for k in range(nodes.status.shape[1]):
        key = key * 31 + nodes.status[row, k]
    slot = (key ^ key >> 15) & (table.shape[0] - 1)
    while table[slot] >= 0:
        other = table[slot]
        same = (
            math.floor(nodes.pose[other, 0] / grain) == x and math.floor(nodes.pose[other, 1] / grain) == y
            and math.floor(math.degrees(nodes.pose[other, 2]) + 0.5) == h
        )  # fmt: skip
        for k in range(nodes.status.shape[1]):
            same = same and nodes.status[row, k] == nodes.status[other, k]
        if same:
            return False
        slot = (slot + 1) & (table.shape[0] - 1)
    table[slot] = row
    return True


@leaf
def _trace(nodes: Nodes, row: int, way: Ints) -> None:
    while nodes.parent[row] >= 0:
        way[nodes.made[row] - 1] = nodes.motion[row]
        row = nodes.parent[row]
