"""Going to where a literal holds, in exact simulation: down a field of steps to go, or a beam over it.

The fields propose: every pose comes from f, and the way has arrived where the predicate itself says so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import leaf, merged
from specshield.policy.planner.due_dates import Agenda, Bounds, note, read_pose
from specshield.policy.planner.fields import FAR, Fields, to_go_after, to_go_at
from specshield.robot.unicycle import Body, step

PATIENCE = 6  # steps without gain after which a walk is stuck
NUDGE = 0.02  # [m] a move that contact cuts shorter than this leads nowhere
DETOURS, DETOUR = 4, 24  # beams out of where a walk gets stuck: how many, and how long [steps]
WIDTH, LENGTH = 12, 64  # poses that a beam keeps, and how long it can be [steps]
TWIN = 0.05  # [m and rad] poses as near as this are one to a beam
GAIN = 2.0  # [steps] nearer than where the walk got stuck: what a detour has to reach

# Of what is needed of a literal: by when, from when until when throughout, and until when as long as the
# literal that one goes to does not hold.
DUE, BEGIN, UNTIL, WITHOUT = range(4)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class World(NamedTuple):
    """What a search reads.

    field [L, 2]: the field that leads to each literal freely, and the one that keeps to what has to hold for
    a while; -1 for none. band: how far these may err [steps]. pad: the motion that stays, or comes nearest to
    it; stands: whether it stays. cost: of one evaluation of the formula [about us]. margin: rho to aim above.
    """

    body: Body
    fields: Fields
    agenda: Agenda
    field: Ints
    band: float
    pad: int
    stands: bool
    cost: float
    margin: float


class Work(NamedTuple):
    """Scratch.

    rho (P,): the predicates at the newest pose; held (l,): the leaves that read signals alone; known (size,):
    all leaves along the way; places [LENGTH + 1, WIDTH, 4], trail [LENGTH + 1, WIDTH, 2]: a beam's poses with
    their steps to go, and each one's parent and motion; spent (1,) [about us].
    """

    values: Floats
    stack: Floats
    rho: Floats
    held: Floats
    known: Floats
    buffer: Floats
    bounds: Bounds
    scores: Floats
    places: Floats
    trail: Ints
    spent: Floats


@leaf
def holds(world: World, k: int, rho: Floats) -> bool:
    return bool(world.agenda.literal[k, 1] * rho[world.agenda.literal[k, 0]] > world.margin)


@leaf
def read_at(world: World, poses: Floats, n: int, work: Work) -> None:
    read_pose(world.agenda, poses[n, 0], poses[n, 1], poses[n, 2], work.values, work.stack, work.rho)


@leaf
def move(world: World, t: int, n: int, motion: int, motions: Ints, poses: Floats, work: Work) -> None:
    """The nth motion. poses (T - t + 1, 3) begin with x_t; work.rho: of poses[n], then of poses[n + 1]."""
    x, y, theta = step(world.body, poses[n, 0], poses[n, 1], poses[n, 2], motion)
    motions[n] = motion
    poses[n + 1, 0], poses[n + 1, 1], poses[n + 1, 2] = x, y, theta
    if x != poses[n, 0] or y != poses[n, 1] or theta != poses[n, 2]:
        read_at(world, poses, n + 1, work)
    note(world.agenda, t + n + 1, work.rho, work.held, work.known)


@leaf
def stay(world: World, t: int, n: int, stop: int, motions: Ints, poses: Floats, work: Work) -> None:
    """Stays from motions[:n] to motions[:stop], or does what comes nearest to it."""
    read_at(world, poses, n, work)
    for i in range(n, stop):
        move(world, t, i, world.pad, motions, poses, work)


@leaf
def _keeps(world: World, goal: int, at: int, need: Ints, rho: Floats) -> bool:
    """Whether everything that has to hold at step `at`, on the way to a goal, does. need (L, 4)."""
    kept, there = True, holds(world, goal, rho)
    for k in range(need.shape[0]):
        asked = need[k, BEGIN] <= at <= need[k, UNTIL] or (at <= need[k, WITHOUT] and not there)
        kept = kept and (not asked or holds(world, k, rho))
    return kept


@leaf
def linger(
    world: World, k: int, t: int, n: int, stop: int, need: Ints, motions: Ints, poses: Floats, work: Work
) -> None:
    """Stays from motions[:n] to motions[:stop]; a robot that cannot stays near where literal k holds, so that
    it does in the end.
    """
    if world.stands:
        stay(world, t, n, stop, motions, poses, work)
        return
    read_at(world, poses, n, work)
    kept = True
    for i in range(n, stop):
        move(world, t, i, world.pad, motions, poses, work)
        kept = kept and _keeps(world, k, t + i + 1, need, work.rho)
    if world.field[k, 0] < 0 or (kept and holds(world, k, work.rho)):
        return
    while n < stop:
        i = min(LENGTH, stop - n)
        after = beam(world, k, world.field[k, 0], t, n, n + i, np.inf, i, i, need, motions, poses, work)
        if after < 0:
            stay(world, t, n, stop, motions, poses, work)
            return
        n = after


@merged
def walk(
    world: World,
    k: int,
    f: int,
    waits: bool,
    t: int,
    n: int,
    stop: int,
    need: Ints,
    motions: Ints,
    poses: Floats,
    work: Work,
) -> int:
    """Goes on from motions[:n] down field f to where literal k holds; how many motions there are then.

    -1 where it does not come there by motions[:stop]. What has to hold does on the way, need (L, 4); waits:
    stay where the way down would break it, instead of going round.
    """
    body, scores = world.body, work.scores
    begin, best, best_n, detours = n, np.inf, n, 0
    x, y, theta = poses[n, 0], poses[n, 1], poses[n, 2]
    while n < stop:
        if n - best_n > PATIENCE:
            detours += 1
            best = to_go_at(body, world.fields, f, poses[best_n, 0], poses[best_n, 1], poses[best_n, 2])
            enough = max(best - GAIN, 0.0)
            n = beam(world, k, f, t, best_n, stop, enough, 0, DETOUR, need, motions, poses, work)
            if n < 0 or detours == DETOURS:
                return -1
            x, y, theta = poses[n, 0], poses[n, 1], poses[n, 2]
            read_at(world, poses, n, work)
            if holds(world, k, work.rho):
                return n
            best, best_n = np.inf, n
            continue
        work.spent[0] += 2.0
        last = motions[n - 1] if n > begin else -1
        to_go_after(body, world.fields, f, x, y, theta, last, scores)
        barred = False
        while True:
            m = world.pad if barred and waits else 0
            for i in range(scores.shape[0]):
                if scores[i] < scores[m] and not (barred and waits):
                    m = i
            padding = not scores[m] < FAR
            m = world.pad if padding else m
            if padding and not barred:
                break
            nx, ny, nth = step(body, x, y, theta, m)
            led = abs(nx - x) + abs(ny - y) > NUDGE or nth != theta
            if led or padding:
                read_pose(world.agenda, nx, ny, nth, work.values, work.stack, work.rho)
                if _keeps(world, k, t + n + 1, need, work.rho):
                    break
                if padding:
                    return -1
                barred = True
            scores[m] = np.inf
        if padding and not barred:
            if not best < FAR:
                best_n = n
            n = best_n + PATIENCE + 1
            continue
        if padding:
            best_n = n + 1
        elif scores[m] < best - 0.25:
            best, best_n = scores[m], n
        x, y, theta = nx, ny, nth
        motions[n] = m
        n += 1
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
        note(world.agenda, t + n, work.rho, work.held, work.known)
        if holds(world, k, work.rho):
            return n
    return -1


@leaf
def beam(
    world: World,
    k: int,
    f: int,
    t: int,
    n: int,
    stop: int,
    enough: float,
    shortest: int,
    longest: int,
    need: Ints,
    motions: Ints,
    poses: Floats,
    work: Work,
) -> int:
    """A beam down field f from motions[:n] to fewer steps to go than `enough`, or to where literal k holds,
    after `shortest` steps or later.

    Returns how many motions there are then, -1 where it finds no way. Other arguments as in `walk`.
    """
    body, places, trail = world.body, work.places, work.trail
    places[0, 0, 0], places[0, 0, 1], places[0, 0, 2] = poses[n, 0], poses[n, 1], poses[n, 2]
    trail[0, 0, 1] = -1
    count, reached = 1, -1
    for i in range(1, min(longest, stop - n) + 1):
        kept = 0
        work.spent[0] += 3.0 * count
        for w in range(count):
            last = trail[i - 1, w, 1]
            moved, turned = (body.translate[last], body.rotate[last]) if last >= 0 else (0.0, 0.0)
            if shortest > 0:
                moved = turned = 0.0  # there is time to go to and fro
            for m in range(body.translate.shape[0]):
                back = body.translate[m] * moved < 0.0 or body.rotate[m] * turned < 0.0
                if back or (m == world.pad and world.stands):
                    continue
                x, y, theta = step(body, places[i - 1, w, 0], places[i - 1, w, 1], places[i - 1, w, 2], m)
                led = abs(x - places[i - 1, w, 0]) + abs(y - places[i - 1, w, 1]) > NUDGE
                if shortest == 0 and not led and theta == places[i - 1, w, 2]:
                    continue
                ahead = to_go_at(body, world.fields, f, x, y, theta)
                if kept == WIDTH and not ahead < places[i, kept - 1, 3]:
                    continue
                read_pose(world.agenda, x, y, theta, work.values, work.stack, work.rho)
                if not _keeps(world, k, t + n + i, need, work.rho):
                    continue
                if holds(world, k, work.rho):
                    ahead = -1.0 - abs(work.rho[world.agenda.literal[k, 0]])
                kept = _keep(i, kept, x, y, theta, ahead, w, m, places, trail)
        if kept == 0:
            return -1
        if i >= shortest and places[i, 0, 3] < enough:
            reached = i
            break
        count = kept
    if reached < 0:
        return -1
    w = 0
    for i in range(reached, 0, -1):
        motions[n + i - 1] = trail[i, w, 1]
        for c in range(3):
            poses[n + i, c] = places[i, w, c]
        w = trail[i, w, 0]
    for i in range(1, reached + 1):
        read_at(world, poses, n + i, work)
        note(world.agenda, t + n + i, work.rho, work.held, work.known)
    return n + reached


@leaf
def _keep(
    i: int,
    kept: int,
    x: float,
    y: float,
    theta: float,
    ahead: float,
    parent: int,
    motion: int,
    places: Floats,
    trail: Ints,
) -> int:
    """Puts a pose in its place among the nearest at step i, unless it is there; how many there are then."""
    for w in range(kept):
        if abs(places[i, w, 0] - x) + abs(places[i, w, 1] - y) + abs(places[i, w, 2] - theta) < TWIN:
            return kept
    at = min(kept, WIDTH - 1)
    while at > 0 and places[i, at - 1, 3] > ahead:
        for c in range(4):
            places[i, at, c] = places[i, at - 1, c]
        trail[i, at, 0], trail[i, at, 1] = trail[i, at - 1, 0], trail[i, at - 1, 1]
        at -= 1
    places[i, at, 0], places[i, at, 1], places[i, at, 2], places[i, at, 3] = x, y, theta, ahead
    trail[i, at, 0], trail[i, at, 1] = parent, motion
    return min(kept + 1, WIDTH)
