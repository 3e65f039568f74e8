"""A way around what the tables do not know of: best-first search over exact motions.

Tables that were made for another map are too hopeful where something new stands in the way: a climb runs
into it, and a beam that keeps the poses of most slack stays there. Where cells only became occupied, the
tables still bound what can be had, so this is A* (Hart, Nilsson and Raphael, 1968): the pose of most slack
goes first, whatever way it lies on. A pose farther on its way goes before one that is a little better, which
keeps the search from filling all of the free space (weighted A*, Pohl 1970).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Int8s, Int32s, Ints
from specshield.compiled import kernel, leaf
from specshield.policy.heap import Heap, pop, push
from specshield.policy.lattice import coordinates, find_corners, reads_heading
from specshield.policy.progress import ALWAYS, EVENTUALLY_ALWAYS, PENDING, Rules, advance
from specshield.policy.progress.recall import forgive, recall
from specshield.policy.reachability.around.field import due, spare_on
from specshield.policy.reachability.guide import (
    Guide,
    Scratch,
    copy_progress,
    make_scratch,
    predicate_at,
    read_due,
    update_progress,
)
from specshield.policy.reachability.tables import SAFE, UNKNOWN, goals_settled, is_broken, slack_at
from specshield.policy.reachability.walk import FAILED, PHASE_END, SETTLED_ALL, climb, rejoin
from specshield.policy.undo import IMPOSSIBLE, NOT_NEEDED, move_back, turn_by
from specshield.robot.barred import is_barred
from specshield.robot.dynamics import around, displacement, longest_motions, motion_count, step, step_from

# Chosen by hand; python -m evaluation worlds says what comes of them.
POSES = 16_384  # that one search may come to, in some 10 ms; a power of two, for the hash table
FEWER = 2_048  # the same, where one decision tries several maps
ONWARD = 0.3  # [steps] of slack that a step farther on its way is worth
PLACE_GRAIN = 20.0  # [1/m] places that round to the same multiples of its inverse count once
HEADING_GRAIN = 60.0 / (2.0 * math.pi)  # [1/rad]
BAND = -3.0  # [steps] of slack: how far the tables may err
NO_WAY, GAVE_UP = -1, -2  # in place of a way: there is none among the poses searched; they were too many
LEGS = 8  # searches for one way, each to the next goal


class Tree(NamedTuple):
    """The poses that a search has come to, N of them, with how: step [N], parent [N], motion [N], and the
    progress there, and its rank [N]. heap: of those to go on from, the highest rank first.
    """

    pose: Floats
    status: Int8s
    run: Ints
    step: Int32s
    parent: Int32s
    motion: Int32s
    rank: Floats
    heap: Heap


@kernel
def is_known(guide: Guide, past: float, history: Floats, signals: Floats, poses: Floats) -> bool:
    """Whether one of the ways poses (M, T - t, 3) settles every goal and breaks nothing. The other arguments
    are those of `continue_all`.
    """
    k_count = guide.rules.kind.shape[0]
    status, run = np.empty(k_count, np.int8), np.empty(k_count, np.int64)
    scratch = make_scratch(guide.rules, 1)
    recall(guide.rules, past, history, signals, status, run)
    forgive(guide.rules, history.shape[0] - 1, status)
    for m in range(poses.shape[0]):
        copy_progress(status, run, scratch.status, scratch.run)
        for i in range(poses.shape[1]):
            x, y, theta = poses[m, i, 0], poses[m, i, 1], poses[m, i, 2]
            update_progress(guide.rules, history.shape[0] + i, x, y, theta, scratch)
        if goals_settled(guide.rules, scratch.status):
            return True
    return False


@kernel
def go_around(
    guide: Guide, past: float, history: Floats, signals: Floats, fields: Floats, poses: Floats, motions: Ints,
    most: int,
) -> int:  # fmt: skip
    """Searches for a way from x_t to every goal. Returns its first motion; then motions (M, T - t) hold it,
    and after each other motion the way back to it. Else NO_WAY, or GAVE_UP where the search came to `most`
    poses. The robot has to be one that can wait.

    fields [K, ny, nx]: the distances to the goals (field.py), or none. poses (M, T - t, 3): overwritten. The
    other arguments are those of `continue_all`.
    """
    t, k_count, steps = history.shape[0] - 1, guide.rules.kind.shape[0], motions.shape[1]
    status, run = np.empty(k_count, np.int8), np.empty(k_count, np.int64)
    recall(guide.rules, past, history, signals, status, run)
    forgive(guide.rules, t, status)
    scratch = make_scratch(guide.rules, motions.shape[0])
    tree = Tree(
        np.empty((most, 3)), np.empty((most, k_count), np.int8), np.empty((most, k_count), np.int64),
        np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most),
        Heap(np.empty(most, np.int32), np.empty(most)),
    )  # fmt: skip
    seen = np.empty(4 * most, np.int32)
    way, led = np.empty(steps, np.int64), np.empty((steps, 3))
    copy_progress(status, run, scratch.status, scratch.run)
    n, outcome = 0, FAILED
    for _ in range(LEGS):
        x, y, theta = history[t, 0], history[t, 1], history[t, 2]
        if n > 0:
            x, y, theta = led[n - 1, 0], led[n - 1, 1], led[n - 1, 2]
        found = _reach(guide, fields, t + n, steps - n, x, y, theta, tree, seen, scratch)
        if found < 0:
            return int(found)
        length = tree.step[found]
        at = found
        while tree.parent[at] >= 0:
            i = n + tree.step[at] - 1
            way[i] = tree.motion[at]
            for c in range(3):
                led[i, c] = tree.pose[at, c]
            at = tree.parent[at]
        n += length
        copy_progress(tree.status[found], tree.run[found], scratch.status, scratch.run)
        if n == 0:
            return NO_WAY
        outcome, n = climb(guide, t, n, way, led, scratch, False)
        if outcome == SETTLED_ALL:
            break
        if outcome == FAILED:
            return NO_WAY
        copy_progress(scratch.high_status, scratch.high_run, scratch.status, scratch.run)
    if outcome != SETTLED_ALL:
        return NO_WAY
    _after_each(guide, t, history[t], status, run, way, led, motions, poses, scratch)
    return int(way[0])


@leaf
def _after_each(
    guide: Guide, t: int, pose: Floats, status: Int8s, run: Ints, way: Ints, led: Floats, motions: Ints,
    poses: Floats, scratch: Scratch,
) -> None:  # fmt: skip
    """Writes the way itself, and after each other first motion the way back to x_t and then the same."""
    for m in range(motions.shape[0]):
        if m == way[0]:
            for i in range(way.shape[0]):
                motions[m, i] = way[i]
                for c in range(3):
                    poses[m, i, c] = led[i, c]
            continue
        x, y, theta = step(guide.body, pose[0], pose[1], pose[2], m)
        motions[m, :] = guide.wait
        motions[m, 0] = m
        poses[m, 0, 0], poses[m, 0, 1], poses[m, 0, 2] = x, y, theta
        turn = turn_by(guide.body, -displacement(guide.body, m)[1]) if theta != pose[2] else NOT_NEEDED
        if turn == IMPOSSIBLE:
            continue
        move = move_back(guide.body, m, math.hypot(x - pose[0], y - pose[1]))
        copy_progress(status, run, scratch.status, scratch.run)
        update_progress(guide.rules, t + 1, x, y, theta, scratch)
        rejoin(guide, t, turn, move, way, led, 0, motions[m], poses[m], scratch)


@leaf
def _reach(
    guide: Guide, fields: Floats, t: int, steps: int, x: float, y: float, theta: float, tree: Tree,
    seen: Int32s, scratch: Scratch,
) -> int:  # fmt: skip
    """The row of a pose from where a climb can go on: one more goal is settled there, or only time is needed
    for that. Else NO_WAY or GAVE_UP. The scratch holds the progress at (x, y, theta).
    """
    body, rules, tables, _, _ = guide
    seen[:] = -1
    stride, _ = longest_motions(body)
    turns_matter = reads_heading(rules)
    _put(tree, 0, x, y, theta, scratch, 0, -1, -1)
    tree.rank[0] = 0.0
    count, size = 1, 0
    size = push(tree.heap, size, 0, 0.0)
    while size > 0:
        here = tree.heap.row[0]
        size = pop(tree.heap, size)
        s = tree.step[here]
        if s > 0 and _arrived(guide, t + s, here, tree, scratch):
            return int(here)
        if s >= steps or count == tree.step.shape[0]:
            continue
        before_x, before_y, before = tree.pose[here, 0], tree.pose[here, 1], tree.pose[here, 2]
        cos, sin, room = around(body, before_x, before_y, before)
        read, corners = False, UNKNOWN  # what is the same after each turn: whether it is known, and how many
        for m in range(motion_count(body)):
            x, y, theta = step_from(body, before_x, before_y, before, cos, sin, room, m)
            stays = x == before_x and y == before_y
            if (stays and theta == before) or count == tree.step.shape[0]:
                continue
            if is_barred(guide.barred, before_x, before_y, before, m):
                continue
            copy_progress(tree.status[here], tree.run[here], scratch.status, scratch.run)
            if not (stays and read):
                read_due(rules, t + s + 1, x, y, theta, scratch)
                read = stays and not turns_matter
            advance(rules, t + s + 1, scratch.predicates, scratch.status, scratch.run)
            if is_broken(scratch.status):
                continue
            _put(tree, count, x, y, theta, scratch, s + 1, here, m)
            slot = _slot_of(tree, count, seen)
            if slot < 0:
                continue
            if stays and corners == UNKNOWN:
                v, u, _ = coordinates(body, tables.pitch, tables.code.shape[2], x, y, theta)
                corners = find_corners(tables.cell, v, u, scratch.corners)
            ahead = slack_at(
                body, rules, tables, x, y, theta, t + s + 1, scratch.status, scratch.run,
                scratch.corners if stays else scratch.ahead, corners if stays else UNKNOWN,
            )  # fmt: skip
            if ahead < BAND:
                seen[slot] = -1  # the end of its chain; its row goes to the next pose
                continue
            spare = spare_on(body, rules, fields, stride, x, y, theta, t + s + 1, scratch.status)
            tree.rank[count] = min(ahead, spare) + ONWARD * (s + 1)
            size = push(tree.heap, size, count, -tree.rank[count])
            count += 1
    return GAVE_UP if count == tree.step.shape[0] else NO_WAY


@leaf
def _arrived(guide: Guide, t: int, row: int, tree: Tree, scratch: Scratch) -> bool:
    """Whether a climb can go on from there: a goal was settled since the root, or waiting is of use."""
    rules, tables = guide.rules, guide.tables
    x, y, theta = tree.pose[row, 0], tree.pose[row, 1], tree.pose[row, 2]
    if tree.rank[row] >= SAFE:
        return True
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == ALWAYS:
            continue
        if tree.status[row, k] != tree.status[0, k]:
            return True
        waits = tree.status[row, k] == PENDING and _has_time(rules, t, tree.status[row], tree.run[row], k)
        if waits and predicate_at(rules, k, x, y, theta, scratch) > rules.margin:
            return True
    phase = tables.phase[t]
    latest = tree.rank[row] - ONWARD * tree.step[row] + t
    return bool(phase < len(tables.end) - 1 and latest >= tables.end[phase] - PHASE_END)


@leaf
def _has_time(rules: Rules, t: int, status: Int8s, run: Ints, goal: int) -> bool:
    """Whether no other goal is due before this one is settled by waiting for it from step t on."""
    until = rules.a[goal]
    if rules.kind[goal] == EVENTUALLY_ALWAYS:
        until = max(until + rules.b[goal], t + rules.b[goal] - rules.c2[goal] + 1 - run[goal])
    for k in range(status.shape[0]):
        if k != goal and rules.kind[k] != ALWAYS and status[k] == PENDING and due(rules, k) <= until:
            return False
    return True


@leaf
def _put(
    tree: Tree, i: int, x: float, y: float, theta: float, scratch: Scratch, s: int, parent: int, motion: int
) -> None:
    tree.pose[i, 0], tree.pose[i, 1], tree.pose[i, 2] = x, y, theta
    copy_progress(scratch.status, scratch.run, tree.status[i], tree.run[i])
    tree.step[i], tree.parent[i], tree.motion[i] = s, parent, motion


@leaf
def _slot_of(tree: Tree, i: int, seen: Int32s) -> int:
    """Where in the hash table row `i` is remembered from now on; -1 where an earlier row has its place,
    heading and progress. At most a quarter of the table is taken, since each of `most` rows takes one slot.
    """
    a, b, c = _rounded(tree.pose, i)
    key = a * 73856093 ^ b * 19349663 ^ c * 83492791
    slot: int = (key ^ key >> 15) & (seen.shape[0] - 1)
    while seen[slot] >= 0:
        other = seen[slot]
        d, e, f = _rounded(tree.pose, other)
        same = a == d and b == e and c == f
        for k in range(tree.status.shape[1]):
            same = same and tree.status[i, k] == tree.status[other, k]
        if same and tree.step[other] <= tree.step[i]:
            return -1
        slot = (slot + 1) & (seen.shape[0] - 1)
    seen[slot] = i
    return slot


@leaf
def _rounded(pose: Floats, i: int) -> tuple[int, int, int]:
    return (
        math.floor(PLACE_GRAIN * pose[i, 0]),
        math.floor(PLACE_GRAIN * pose[i, 1]),
        math.floor(HEADING_GRAIN * pose[i, 2] + 0.5),
    )
