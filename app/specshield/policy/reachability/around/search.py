"""A way around obstacles that the tables do not know of: best-first search over exact motions.

Tables that were made for another map are too hopeful where something new stands in the way: a climb runs
into it, and a beam that keeps the poses of most slack stays there. As long as cells only became occupied, the
tables still bound the slack, so this is A* (Hart, Nilsson and Raphael, 1968): the pose of most slack goes
first, whatever way it lies on. A pose farther on its way goes before one that is a little better, which keeps
the search from filling all of the free space (weighted A*, Pohl 1970).

A robot that cannot wait turns on the spot where another one would wait. Its tables tell step by step what is
feasible, and not how much there is to spare: so the distances alone say which pose goes first.
"""

from __future__ import annotations

import math

import numpy as np

from specshield.arrays import Floats, Int8s, Ints, copy_row
from specshield.caution.surprise.barred import is_barred
from specshield.compiled import Boxed, kernel, leaf
from specshield.policy.detour import join
from specshield.policy.lattice import coordinates, find_corners, reads_heading
from specshield.policy.progress import ALWAYS, EVENTUALLY_ALWAYS, PENDING, Past, Rules, advance, resume
from specshield.policy.reachability.around.field import spare_on
from specshield.policy.reachability.guide import (
    copy_progress,
    due,
    make_scratch,
    predicate_at,
    read_due,
    update_progress,
)
from specshield.policy.reachability.search import begin, go_back
from specshield.policy.reachability.tables import (
    SAFE,
    UNKNOWN,
    Guide,
    Scratch,
    goals_settled,
    guided,
    is_broken,
    slack_at,
)
from specshield.policy.reachability.walk import FAILED, PHASE_END, SETTLED_ALL, STUCK, climb
from specshield.policy.tree import Grain, Tree, enter, make_tree, pop, push, put, trace
from specshield.policy.undo import IMPOSSIBLE, turning_motion
from specshield.robot.contact import overlap
from specshield.robot.dynamics import around, longest_motions, motion_count, simulate, step, step_from

# Chosen by hand; python -m evaluation worlds says what comes of them.
POSES = 16_384  # that one search may make, in some 10 ms
FEWER = 2_048  # the same, if one decision tries several maps
INSIDE = 128  # the same, from inside an obstacle or off the map, where each pose costs up to 190 us
ONWARD = 0.3  # [steps] of slack that a step farther on its way is worth
GRAIN = Grain(20.0, 1.0, 60.0 / (2.0 * math.pi))  # poses count once within 5 cm and 6 degrees
BAND = -3.0  # [steps] of slack: how far the tables may err
NO_WAY, GAVE_UP = -1, -2  # in place of a way: all poses were searched; there were too many of them
LEGS = 8  # searches for one way, each to the next goal


@kernel
def is_known(boxed: Boxed[Guide], margin: float, past: Past, poses: Floats) -> bool:
    """Whether one of the ways poses (M, T - t, 3) settles every goal and breaks nothing."""
    rules = guided(boxed, margin).rules
    now, scratch = resume(rules, past), make_scratch(rules, 1)
    for m in range(poses.shape[0]):
        copy_progress(now.status, now.run, scratch.status, scratch.run)
        for i in range(poses.shape[1]):
            x, y, theta = poses[m, i, 0], poses[m, i, 1], poses[m, i, 2]
            update_progress(rules, now.t + 1 + i, x, y, theta, scratch)
        if goals_settled(rules, scratch.status):
            return True
    return False


@kernel
def go_around(
    boxed: Boxed[Guide], margin: float, past: Past, fields: Floats, poses: Floats, motions: Ints, most: int
) -> int:
    """Searches for a way from x_t to every goal. Returns its first motion, else NO_WAY, or GAVE_UP if the
    search made `most` poses. Writes the way, and a way back onto it after each other motion, into motions
    (M, T - t).

    fields [K, ny, nx]: the distances to the goals (field.py), or NO_FIELDS, which only a robot that can wait
    can do without. poses (M, T - t, 3): overwritten.
    """
    guide, (count, steps) = guided(boxed, margin), motions.shape
    starts = begin(guide, past, np.ones(count, np.bool_), motions, poses)
    now, t, scratch = starts.now, starts.now.t, starts.scratch
    inside = overlap(guide.body, now.pose[0], now.pose[1], now.pose[2]) >= guide.body.radius
    most = min(most, INSIDE) if inside else most
    tree = make_tree(most, guide.rules.kind.shape[0])
    way, led = np.empty(steps, np.int64), np.empty((steps, 3))
    copy_progress(now.status, now.run, scratch.status, scratch.run)
    n, outcome, reached, status, run = 0, FAILED, 0, now.status.copy(), now.run.copy()
    for _ in range(LEGS):
        here = led[n - 1] if n > 0 else now.pose
        found = _reach(guide, fields, t + n, steps - n, here, tree, scratch)
        if found == NO_WAY and n > reached:  # the climb led a robot that cannot back out up to an obstacle
            n = reached
            copy_progress(status, run, scratch.status, scratch.run)
            continue
        if found < 0:
            return int(found)
        length = tree.made[found]
        trace(tree, found, way[n:])
        simulate(guide.body, here, way[n : n + length], led[n : n + length])
        n = reached = n + length
        copy_progress(tree.status[found], tree.run[found], status, run)
        copy_progress(status, run, scratch.status, scratch.run)
        if guide.wait < 0:
            outcome, n = _linger(guide, t, n, way, led, scratch)
            if outcome == STUCK:
                continue
        else:
            outcome, n = climb(guide, t, n, way, led, scratch, False)
        if outcome != STUCK:
            break
        copy_progress(scratch.high_status, scratch.high_run, scratch.status, scratch.run)
    if outcome != SETTLED_ALL:
        return NO_WAY
    for m in range(count):
        motions[m, 1:] = guide.wait if guide.wait >= 0 else m
        if m == way[0]:
            copy_row(way, motions[m])
        elif guide.wait >= 0:
            go_back(guide, m, way, led, starts)
        elif starts.turn[m] != IMPOSSIBLE:
            join(starts.turn[m], starts.move[m], way, 0, guide.wait, motions[m])
    return int(way[0])


@leaf
def _linger(guide: Guide, t: int, n: int, way: Ints, led: Floats, scratch: Scratch) -> tuple[int, int]:
    """Turns on the spot after way[:n], as long as some pending goal holds there; to the horizon if every goal
    is settled. Returns SETTLED_ALL, FAILED, or STUCK if another goal is next; and how many motions there are
    then. Writes way (T - t,) and led (T - t, 3), where it leads, from n on.
    """
    rules, turning = guide.rules, turning_motion(guide.body)
    x, y, theta = led[n - 1, 0], led[n - 1, 1], led[n - 1, 2]
    while turning >= 0 and n < way.shape[0]:
        holds = goals_settled(rules, scratch.status)
        for k in range(rules.kind.shape[0]):
            if rules.kind[k] != ALWAYS and scratch.status[k] == PENDING:
                waits = _has_time(rules, t + n, scratch.status, scratch.run, k)
                holds = holds or (waits and predicate_at(rules, k, x, y, theta, scratch) > rules.margin)
        if not holds or is_broken(scratch.status):
            break
        x, y, theta = step(guide.body, x, y, theta, turning)
        way[n], led[n, 0], led[n, 1], led[n, 2] = turning, x, y, theta
        n += 1
        update_progress(rules, t + n, x, y, theta, scratch)
    if goals_settled(rules, scratch.status):
        way[n:] = max(turning, 0)
        return SETTLED_ALL, n
    return (FAILED if is_broken(scratch.status) or n == way.shape[0] else STUCK), n


@leaf
def _reach(
    guide: Guide, fields: Floats, t: int, steps: int, pose: Floats, tree: Tree, scratch: Scratch
) -> int:
    """The row of a pose from where a climb can go on, see `_arrived`; else NO_WAY or GAVE_UP. The scratch
    holds the progress at `pose` (3,).
    """
    body, rules, tables, _, _ = guide
    tree.table[:] = -1
    stride, _ = longest_motions(body)
    turns_matter = reads_heading(rules.programs, rules.regions)
    put(tree, 0, pose[0], pose[1], pose[2], 0, -1, -1)
    copy_progress(scratch.status, scratch.run, tree.status[0], tree.run[0])
    # The tables know no way out of places narrower than their lattice, so they do not bound a search there.
    bounded = slack_at(guide, pose[0], pose[1], pose[2], t, scratch, scratch.ahead, UNKNOWN) >= BAND
    # Distances bound it too, where goals are places alone and the robot overlaps no obstacle by much.
    near = 0.5 * body.resolution
    timed = overlap(body, pose[0], pose[1], pose[2]) <= near and len(rules.signals) == 0 and not turns_matter
    count, size = 1, push(tree.heap, 0, 0, 0.0)
    while size > 0:
        here, rank = tree.heap.row[0], -tree.heap.rank[0]
        size = pop(tree.heap, size)
        s = tree.made[here]
        if s > 0 and _arrived(guide, t + s, here, rank, tree, scratch):
            return int(here)
        if s >= steps or count == tree.made.shape[0]:
            continue
        before_x, before_y, before = tree.pose[here, 0], tree.pose[here, 1], tree.pose[here, 2]
        cos, sin, room = around(body, before_x, before_y, before)
        read, corners = False, UNKNOWN  # what is the same after each turn: whether it is known, and how many
        for m in range(motion_count(body)):
            x, y, theta = step_from(body, before_x, before_y, before, cos, sin, room, m)
            stays = x == before_x and y == before_y
            if (stays and theta == before) or count == tree.made.shape[0]:
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
            put(tree, count, x, y, theta, s + 1, here, m)
            copy_progress(scratch.status, scratch.run, tree.status[count], tree.run[count])
            slot = enter(tree, count, GRAIN, True)
            if slot < 0:
                continue
            if stays and corners == UNKNOWN:
                v, u, _ = coordinates(body, tables.pitch, tables.code.shape[2], x, y, theta)
                corners = find_corners(tables.cell, v, u, scratch.corners)
            about, known = (scratch.corners, corners) if stays else (scratch.ahead, UNKNOWN)
            ahead = slack_at(guide, x, y, theta, t + s + 1, scratch, about, known)
            spare, most = spare_on(guide, fields, stride, x, y, theta, t + s + 1, scratch.status)
            if (ahead < BAND and bounded) or (most < 0.0 and timed):
                tree.table[slot] = -1  # its row is used again
                continue
            ahead = max(ahead, BAND) if guide.wait >= 0 or ahead >= SAFE or spare == math.inf else spare
            size = push(tree.heap, size, count, -(min(ahead, spare) + ONWARD * (s + 1)))
            count += 1
    return GAVE_UP if count == tree.made.shape[0] else NO_WAY


@leaf
def _arrived(guide: Guide, t: int, row: int, rank: float, tree: Tree, scratch: Scratch) -> bool:
    """Whether a climb can go on from there: a goal was settled since the root, or waiting is of use."""
    rules, tables = guide.rules, guide.tables
    x, y, theta = tree.pose[row, 0], tree.pose[row, 1], tree.pose[row, 2]
    if rank >= SAFE:
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
    latest = rank - ONWARD * tree.made[row] + t
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
