"""Going to where a literal holds: down a field of steps to go, by the best motion or by a beam.

The fields only propose. Poses come from f, and the robot has arrived where the predicate itself says so.
"""

from __future__ import annotations

import numpy as np

from specshield.arrays import Floats, Ints, copy_row
from specshield.compiled import inlined, leaf
from specshield.policy.lattice import leads_back, leads_on
from specshield.policy.planner.due_dates import read_pose
from specshield.policy.planner.fields import OUT_OF_REACH, to_go_after, to_go_at
from specshield.policy.planner.literals import PREDICATE
from specshield.policy.planner.way import Way, World, holds, keeps, lead, move, note_at, read_at, stay
from specshield.robot.dynamics import motion_count

# Chosen by hand; nothing measured.
STUCK_AFTER = 6  # [steps] without a gain after which a descent is stuck
GAIN = 0.25  # [steps] nearer than ever before: what counts as a gain
DETOURS = 4  # beams out of places where one descent is stuck
DETOUR_LENGTH = 24  # [steps] of such a beam, at most
DETOUR_GAIN = 2.0  # [steps] nearer than where the descent was stuck: what such a beam has to reach
BEAM_WIDTH = 12  # poses that a beam keeps at a step
BEAM_LENGTH = 64  # [steps] of a beam, at most
SAME_POSE = 0.05  # [m + rad] poses that differ by less than this count once in a beam

Place = tuple[float, float, float, float]
Pair = tuple[int, int]


@inlined
def descend(world: World, way: Way, k: int, f: int, waits: bool, n: int, stop: int, need: Ints) -> int:
    """Goes on from motions[:n] down field f to where literal k holds, and keeps what has to hold on the way,
    need (L, 4). Returns how many motions there are then, -1 if `stop` motions do not lead there.

    waits: whether the robot stays, instead of going round, where the way down would break what has to hold.
    """
    body, scores, motions, poses = world.body, way.scores, way.motions, way.poses
    begin, best, best_n, detours = n, np.inf, n, 0
    x, y, theta = poses[n, 0], poses[n, 1], poses[n, 2]
    while n < stop:
        if n - best_n > STUCK_AFTER:
            detours += 1
            best = to_go_at(body, world.fields, f, poses[best_n, 0], poses[best_n, 1], poses[best_n, 2])
            enough = max(best - DETOUR_GAIN, 0.0)
            n = descend_by_beam(world, way, k, f, best_n, stop, enough, (0, DETOUR_LENGTH), need)
            if n < 0 or detours == DETOURS:
                return -1
            x, y, theta = poses[n, 0], poses[n, 1], poses[n, 2]
            read_at(world, way, n)
            if holds(world, k, way.rho):
                return n
            best, best_n = np.inf, n
            continue
        way.spent[0] += 2.0
        last = motions[n - 1] if n > begin else -1
        to_go_after(body, world.fields, f, x, y, theta, last, scores)
        barred = False  # whether a motion that leads down would break what has to hold
        while True:
            m = int(np.argmin(scores))
            padding = (barred and waits) or not scores[m] < OUT_OF_REACH
            m = world.pad if padding else m
            if padding and not barred:
                break
            nx, ny, nth = lead(world, x, y, theta, m)
            led = leads_on(body, m, x, y, theta, (nx, ny, nth))
            if led or padding:
                read_pose(world.literals, nx, ny, nth, way.values, way.stack, way.rho)
                if keeps(world, k, way.t + n + 1, need, way.rho):
                    break
                if padding:
                    return -1
                barred = True
            scores[m] = np.inf
        if padding and not barred:
            if not best < OUT_OF_REACH:
                best_n = n
            n = best_n + STUCK_AFTER + 1
            continue
        if padding:
            best_n = n + 1
        elif scores[m] < best - GAIN:
            best, best_n = scores[m], n
        x, y, theta = nx, ny, nth
        motions[n] = m
        n += 1
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
        note_at(world, way, n)
        if holds(world, k, way.rho):
            return n
    return -1


@leaf
def descend_by_beam(
    world: World, way: Way, k: int, f: int, n: int, stop: int, enough: float, length: Pair, need: Ints
) -> int:
    """Goes on from motions[:n] by a beam down field f, to fewer steps to go than `enough` or to where literal
    k holds. length: the fewest and the most steps of the beam. The other arguments and the result are those
    of `descend`.
    """
    body, places, trail, (shortest, longest) = world.body, way.places, way.trail, length
    copy_row(way.poses[n], places[0, 0])
    trail[0, 0, 1] = -1
    count = 1
    for i in range(1, min(longest, stop - n) + 1):
        kept = 0
        way.spent[0] += 3.0 * count
        for w in range(count):
            last = trail[i - 1, w, 1] if shortest == 0 else -1  # if there is time, it may go to and fro
            before = places[i - 1, w]
            for m in range(motion_count(body)):
                if leads_back(body, last, m) or (m == world.pad and world.stands):
                    continue
                x, y, theta = lead(world, before[0], before[1], before[2], m)
                led = leads_on(body, m, before[0], before[1], before[2], (x, y, theta))
                if shortest == 0 and not led:
                    continue
                ahead = to_go_at(body, world.fields, f, x, y, theta)
                if kept == BEAM_WIDTH and not ahead < places[i, kept - 1, 3]:
                    continue
                read_pose(world.literals, x, y, theta, way.values, way.stack, way.rho)
                if not keeps(world, k, way.t + n + i, need, way.rho):
                    continue
                if holds(world, k, way.rho):
                    ahead = -1.0 - abs(way.rho[world.literals.literal[k, PREDICATE]])
                kept = _insert(places[i], trail[i], kept, (x, y, theta, ahead), (w, m))
        if kept == 0:
            return -1
        if i >= shortest and places[i, 0, 3] < enough:
            _write(world, way, n, i)
            return n + i
        count = kept
    return -1


@leaf
def _insert(places: Floats, trail: Ints, kept: int, place: Place, link: Pair) -> int:
    """Puts a place among the `kept` ones of a beam's step, in the order of the steps to go, unless one of
    them has the same pose; returns how many there are then. places [width, 4], trail [width, 2], and one row
    of each: `place` and `link`.
    """
    x, y, theta, ahead = place
    for w in range(kept):
        if abs(places[w, 0] - x) + abs(places[w, 1] - y) + abs(places[w, 2] - theta) < SAME_POSE:
            return kept
    at = min(kept, BEAM_WIDTH - 1)
    while at > 0 and places[at - 1, 3] > ahead:
        copy_row(places[at - 1], places[at])
        copy_row(trail[at - 1], trail[at])
        at -= 1
    places[at, 0], places[at, 1], places[at, 2], places[at, 3] = place
    trail[at, 0], trail[at, 1] = link
    return min(kept + 1, BEAM_WIDTH)


@leaf
def _write(world: World, way: Way, n: int, steps: int) -> None:
    """Appends the best way of a beam, of so many steps, to motions[:n]."""
    w = 0
    for i in range(steps, 0, -1):
        way.motions[n + i - 1] = way.trail[i, w, 1]
        for c in range(3):
            way.poses[n + i, c] = way.places[i, w, c]
        w = way.trail[i, w, 0]
    for i in range(n + 1, n + steps + 1):
        read_at(world, way, i)
        note_at(world, way, i)


@leaf
def linger(world: World, way: Way, k: int, n: int, stop: int, need: Ints) -> None:
    """Stays from motions[:n] to motions[:stop]. A robot that cannot stay moves about near to where literal k
    holds, so that the literal holds in the end.
    """
    if world.stands:
        stay(world, way, n, stop)
        return
    read_at(world, way, n)
    kept = True
    for i in range(n, stop):
        move(world, way, i, world.pad)
        kept = kept and keeps(world, k, way.t + i + 1, need, way.rho)
    if world.field[k, 0] < 0 or (kept and holds(world, k, way.rho)):
        return
    while n < stop:
        i = min(BEAM_LENGTH, stop - n)
        after = descend_by_beam(world, way, k, world.field[k, 0], n, n + i, np.inf, (i, i), need)
        if after < 0:
            stay(world, way, n, stop)
            return
        n = after
