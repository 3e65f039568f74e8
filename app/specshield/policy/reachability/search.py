"""A continuation to the horizon after each first motion, out of the tables.

From the motion of most slack the robot climbs the latest feasible times (walk.py). For any other motion it is
mostly enough to undo it and go the same way, or to turn and go the way of a motion that led to the same
place. Where that comes too late, or the climb gets stuck, a beam looks for a way (beam.py): first a narrow
one, which takes a sixth of the time and mostly finds a way where there is one. A robot that cannot stand
still has tables step by step, and all its ways are found by beams.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Int8s, Ints
from specshield.compiled import Boxed, kernel, leaf
from specshield.policy.detour import copy_ways, find_sibling, find_twins, join
from specshield.policy.progress import Past, Present, advance, resume
from specshield.policy.reachability.beam import EASY, MAX_ROOTS, MAX_SCORED, MAX_TRIED, Terms, beam_search
from specshield.policy.reachability.guide import (
    copy_progress,
    fill,
    is_over,
    make_scratch,
    read_due,
    update_progress,
)
from specshield.policy.reachability.tables import (
    HOPELESS,
    SAFE,
    Guide,
    Scratch,
    goals_settled,
    guided,
    is_broken,
    slack,
)
from specshield.policy.reachability.walk import SETTLED_ALL, STUCK, climb
from specshield.policy.undo import IMPOSSIBLE, NOT_NEEDED, move_back, turn_by
from specshield.robot.dynamics import displacement, motion_count, simulate, step

# Chosen by hand; nothing measured.
ESCAPE_GAIN = 2.0  # [steps] how much later than where a climb got stuck a way out has to lead
ESCAPE_LOSS = 6.0  # [steps] of slack that a way out may cost
ESCAPE_LENGTH = 24  # [steps] of a way out, at most
MAX_ESCAPES = 8  # ways out of places where one climb is stuck
ROOTS = 4  # first motions that one beam serves, where others may then go the ways it finds
NARROW_SHARE = 2  # poses that a first beam keeps for each first motion
SMALL = 30_000  # poses of a lattice on which nearly every way can be tried
SMALL_SHARE = 512  # poses that a beam keeps for each first motion on such a lattice


class Starts(NamedTuple):
    """What is known after each first motion [M].

    now: before it. motions [M, T - t], poses [M, T - t, 3]: the way that begins with it, and where that
    leads. status, run [M, K]: the progress. slack [steps]. turn, move: the motions that nearly undo it,
    NOT_NEEDED where one is enough; the turn may be IMPOSSIBLE. settled: whether a way that settles every goal
    was found. twin: the first motion that ends in the same pose. order: the motions by falling slack, the
    lowest index first on ties. wanted: whether a way is asked for. sibling (3,): scratch of `find_sibling`.
    """

    now: Present
    motions: Ints
    poses: Floats
    status: Int8s
    run: Ints
    slack: Floats
    turn: Ints
    move: Ints
    settled: Bools
    twin: Ints
    order: Ints
    wanted: Bools
    sibling: Ints
    scratch: Scratch


@kernel
def begin(guide: Guide, past: Past, wanted: Bools, motions: Ints, poses: Floats) -> Starts:
    """Makes every motion once from x_t. A motion whose twin is wanted becomes wanted; if none is, so does the
    motion of most slack. The arguments are those of `continue_all`.
    """
    body, rules, (count, _) = guide.body, guide.rules, motions.shape
    now, k_count = resume(rules, past), rules.kind.shape[0]
    pose = now.pose
    scratch = make_scratch(rules, count)
    status, run = np.empty((count, k_count), np.int8), np.empty((count, k_count), np.int64)
    slacks, twin = np.empty(count), np.empty(count, np.int64)
    turn, move = np.empty(count, np.int64), np.empty(count, np.int64)
    for m in range(count):
        x, y, theta = step(body, pose[0], pose[1], pose[2], m)
        motions[m, 0] = m
        poses[m, 0, 0], poses[m, 0, 1], poses[m, 0, 2] = x, y, theta
        turn[m] = turn_by(body, -displacement(body, m)[1]) if theta != pose[2] else NOT_NEEDED
        move[m] = move_back(body, m, math.hypot(x - pose[0], y - pose[1]))
        copy_progress(now.status, now.run, scratch.status, scratch.run)
        update_progress(rules, now.t + 1, x, y, theta, scratch)
        copy_progress(scratch.status, scratch.run, status[m], run[m])
        slacks[m] = slack(guide, x, y, theta, now.t + 1, scratch)
    find_twins(poses, twin)
    order, settled = np.empty(count, np.int64), np.zeros(count, np.bool_)
    for m in range(count):  # numba takes a second to compile a sort
        k = m
        while k > 0 and slacks[order[k - 1]] < slacks[m]:
            order[k] = order[k - 1]
            k -= 1
        order[k] = m
    if not np.any(wanted):
        waits = guide.wait >= 0 and slacks[guide.wait] == slacks[order[0]]
        wanted[guide.wait if waits else order[0]] = True
    for m in range(count):
        wanted[twin[m]] |= wanted[m]
    sibling = np.empty(3, np.int64)
    return Starts(
        now, motions, poses, status, run, slacks, turn, move, settled, twin, order, wanted, sibling, scratch
    )


@kernel
def continue_all(
    boxed: Boxed[Guide],
    margin: float,
    width: int,
    past: Past,
    wanted: Bools,
    lowest: float,
    motions: Ints,
    poses: Floats,
) -> int:
    """Writes a continuation after each `wanted` (M,) first motion into motions (M, T - t), and where it leads
    into poses (M, T - t, 3); returns the motion of most slack. -1, and nothing is written, where none that is
    wanted has a slack of at least `lowest` [steps]; no beam looks for a way after one that has less.

    margin: what the rules ask for [m]. width: the poses that a beam keeps for each first motion. What is
    written of motions that are not wanted need not be a way.
    """
    guide = guided(boxed, margin)
    starts = begin(guide, past, wanted, motions, poses)
    t, scratch, order, twin, settled = starts.now.t, starts.scratch, starts.order, starts.twin, starts.settled
    if not np.any(wanted & (starts.slack >= lowest)):
        return -1
    walked = np.empty(order.shape[0], np.int64)
    waits, base, ways = guide.wait >= 0, -1, 0
    for m in order:
        if twin[m] != m or not (wanted[m] or base < 0):
            continue
        if not waits:  # beams find all its ways: until one does, it repeats the motion
            motions[m, 1:] = m
            simulate(guide.body, poses[m, 0], motions[m, 1:], poses[m, 1:])
            settled[m] = starts.slack[m] == SAFE
            continue
        ahead = starts.slack[m]
        settled[m] = join_sibling(guide, walked[:ways], int(m), starts)
        if base >= 0 and not settled[m]:
            settled[m] = go_back(guide, int(m), motions[base], poses[base], starts)
        if not settled[m] and (ahead >= 0.0 or base < 0 or starts.turn[m] == IMPOSSIBLE):
            copy_progress(starts.status[m], starts.run[m], scratch.status, scratch.run)
            escapes = ahead >= (0.0 if base < 0 else EASY)
            settled[m] = _follow(guide, width, t, 1, escapes, motions[m], poses[m], scratch)
            if settled[m]:
                walked[ways] = m
                ways += 1
        if settled[m] and base < 0:
            base = int(m)
    every = 1 + (order.shape[0] - 1) // (MAX_SCORED if waits else MAX_TRIED)
    while True:
        late = guide.tables.late
        _beam_out(guide, min(NARROW_SHARE, width), width, max(0.5 * late, lowest), every, starts)
        _beam_out(guide, width, width, max(late, lowest), every, starts)
        if every == 1 or np.any(settled):
            break
        every = 1
    if guide.tables.code.shape[1] * guide.tables.code.shape[2] <= SMALL:
        _beam_out(guide, SMALL_SHARE, width, max(2.0 * HOPELESS, lowest), 1, starts)
    copy_ways(motions, poses, twin)
    best = order[0]
    return int(guide.wait if waits and starts.slack[guide.wait] == starts.slack[best] else best)


@leaf
def join_sibling(guide: Guide, known: Ints, m: int, starts: Starts) -> bool:
    """Lets motion m join the way of one of the motions `known` that led to the same place. Returns whether
    every goal was settled.
    """
    motions, poses, found = starts.motions, starts.poses, starts.sibling
    find_sibling(guide.body, poses, known, m, True, found)
    other, turn, at = found[0], found[1], found[2]
    return other >= 0 and _rejoin(guide, turn, -1, motions[other], poses[other], at, m, starts)


@leaf
def go_back(guide: Guide, m: int, base: Ints, led: Floats, starts: Starts) -> bool:
    """Undoes motion m to go by `base` (T - t,), a way from x_t that leads to the poses `led` (T - t, 3).
    Returns whether every goal was settled; if no motion undoes it, nothing is written.
    """
    turn, move = starts.turn[m], starts.move[m]
    return turn != IMPOSSIBLE and _rejoin(guide, turn, move, base, led, 0, m, starts)


@leaf
def _rejoin(
    guide: Guide, turn: int, move: int, base: Ints, led: Floats, at: int, m: int, starts: Starts
) -> bool:
    """Goes on after motion m by `turn` and `move`, then by `base`, a way to every goal: see `join`.

    led (T - t, 3): the poses of `base`, which are taken over from where the robot is at the very same pose.
    The robot may be only nearly on that way, so the result says whether every goal was settled.
    """
    body, rules, tables, wait, _ = guide
    t, motions, poses, scratch = starts.now.t, starts.motions[m], starts.poses[m], starts.scratch
    copy_progress(starts.status[m], starts.run[m], scratch.status, scratch.run)
    join(turn, move, base, at, wait, motions)
    x, y, theta = poses[0, 0], poses[0, 1], poses[0, 2]
    n, looked, joined = 1, False, 1 + (turn >= 0) + (move >= 0)
    while n < motions.shape[0] and not is_over(rules, tables, t + n, scratch.status):
        if is_broken(scratch.status):
            break
        if motions[n] != wait:
            known = False
            if n >= joined:  # `base` has the same motions in the same order, waits apart
                while base[at] == wait:
                    at += 1
                known = at > 0 and led[at - 1, 0] == x and led[at - 1, 1] == y and led[at - 1, 2] == theta
                at += 1
            if known:
                x, y, theta = led[at - 1, 0], led[at - 1, 1], led[at - 1, 2]
            else:
                x, y, theta = step(body, x, y, theta, motions[n])
            update_progress(rules, t + n + 1, x, y, theta, scratch)
            looked = False
        else:
            if not looked:
                read_due(rules, t + motions.shape[0], x, y, theta, scratch)
            looked = True
            advance(rules, t + n + 1, scratch.predicates, scratch.status, scratch.run)
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
        n += 1
    fill(n, wait, motions, poses)
    return goals_settled(rules, scratch.status)


@kernel
def _follow(
    guide: Guide, width: int, t: int, n: int, escapes: bool, motions: Ints, poses: Floats, scratch: Scratch
) -> bool:
    """Climbs on from motions[:n]; if that gets stuck, a short beam leads out, provided that `escapes` is
    true. Returns whether every goal was settled.
    """
    outcome, n = climb(guide, t, n, motions, poses, scratch, True)
    for _ in range(MAX_ESCAPES if escapes else 0):
        if outcome != STUCK:
            break
        status, run = scratch.high_status.copy().reshape(1, -1), scratch.high_run.copy().reshape(1, -1)
        x, y, theta = poses[n - 1]
        copy_progress(status[0], run[0], scratch.status, scratch.run)
        high = t + n + slack(guide, x, y, theta, t + n, scratch)
        every = 1 + (motion_count(guide.body) - 1) // MAX_SCORED
        terms = Terms(width, high - (t + n) - ESCAPE_LOSS, high + ESCAPE_GAIN, every)
        steps = min(motions.shape[0] - n, ESCAPE_LENGTH)
        way, taken = beam_search(guide, t + n, poses[n - 1 : n], status, run, steps, terms, scratch)
        if taken[0] == 0:
            break
        copy_progress(status[0], run[0], scratch.status, scratch.run)
        n = take(guide, t, n, way[0, : taken[0]], motions, poses, scratch)
        outcome, n = climb(guide, t, n, motions, poses, scratch, True)
    if outcome == STUCK:
        fill(n, guide.wait, motions, poses)
    return outcome == SETTLED_ALL


@leaf
def take(guide: Guide, t: int, n: int, way: Ints, motions: Ints, poses: Floats, scratch: Scratch) -> int:
    """Appends `way` to motions[:n], whose progress the scratch holds; returns how many there are then."""
    x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
    for i in range(way.shape[0]):
        x, y, theta = step(guide.body, x, y, theta, way[i])
        motions[n] = way[i]
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
        n += 1
        update_progress(guide.rules, t + n, x, y, theta, scratch)
    return n


@kernel
def _beam_out(guide: Guide, share: int, width: int, band: float, every: int, starts: Starts) -> None:
    """Looks for a way after every first motion that is wanted, has no way yet, and has a slack of at least
    `band` [steps]. share, every: see `Terms`; width: see `continue_all`.
    """
    t, motions, poses, scratch = starts.now.t, starts.motions, starts.poses, starts.scratch
    steps, sought = motions.shape[1] - 1, starts.wanted & ~starts.settled & (starts.slack >= band)
    roots = np.array([m for m in starts.order if starts.twin[m] == m and sought[m]], dtype=np.int64)
    if steps == 0:
        return
    most = ROOTS if guide.wait >= 0 else MAX_ROOTS
    while roots.shape[0] > 0:
        some, rest = roots[:most], roots[most:]
        here, status, run = poses[some, 0], starts.status[some], starts.run[some]
        terms = Terms(share, band, np.inf, every)
        way, taken = beam_search(guide, t + 1, here, status, run, steps, terms, scratch)
        for i in range(some.shape[0]):
            m = some[i]
            if taken[i] > 0:
                copy_progress(starts.status[m], starts.run[m], scratch.status, scratch.run)
                n = take(guide, t, 1, way[i, : taken[i]], motions[m], poses[m], scratch)
                if guide.wait >= 0:
                    starts.settled[m] = _follow(guide, width, t, n, True, motions[m], poses[m], scratch)
                    continue
                starts.settled[m] = goals_settled(guide.rules, scratch.status)
                simulate(guide.body, poses[m, n - 1], motions[m, n:], poses[m, n:])
        if guide.wait >= 0:
            known = some[starts.settled[some]]
            if known.shape[0] == 0:  # others will hardly have a way either, so more of them share a beam
                most = min(2 * most, MAX_ROOTS)
            for m in rest:
                starts.settled[m] = join_sibling(guide, known, m, starts)
        roots = rest[~starts.settled[rest]]
