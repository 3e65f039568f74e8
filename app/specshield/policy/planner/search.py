"""Plans for any formula: go to where a predicate holds, stay, go on; searched in exact simulation.

A node of the search is a simulated prefix. Its children serve one literal each, the one due first before
the others: walk to where it holds and stay until it is not due any more; a robot that cannot stay keeps
near, and the last children of its nodes are its single motions. A child that no continuation can save (the
upper bound on rho) is cut; a node from which staying to the horizon satisfies the formula ends the search.
The order is right nearly always, so the search tries first the ways that depart least from it (limited
discrepancy search, Harvey and Ginsberg 1995). What it may spend is counted, not timed: one question has one
answer.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import leaf, merged
from specshield.policy.planner.approach import (
    BEGIN,
    DUE,
    LENGTH,
    UNTIL,
    WITHOUT,
    Work,
    World,
    beam,
    holds,
    linger,
    move,
    read_at,
    stay,
    walk,
)
from specshield.policy.planner.due_dates import (
    NEVER,
    due,
    foresee,
    is_open,
    needed_until,
    needed_without,
    stay_for,
)
from specshield.policy.planner.fields import to_go_at
from specshield.stl.tree import tree_value

DEEP = 128  # nodes on one way, at most
SPARE = 3  # [steps] left over where one departs as late as can be

MADE, COUNT, TRIED, OPENED, USED = range(5)  # of a node
KEY, LITERAL, BEFORE, STAY, KEEP = range(5)  # of a child
# Its key: which kind comes first; then what is due.
FIRST, SECOND, LATER, LAST, ANY = 0, 1 << 20, 1 << 21, 1 << 22, 1 << 23

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Nodes(NamedTuple):
    """The nodes from the root to the newest.

    state [DEEP, 5]: motions MADE, COUNT of children, how many were TRIED, how many of those were OPENED,
    discrepancies USED. need [DEEP, L, 4]: by when a literal is DUE, from which step (BEGIN) UNTIL which it
    has to hold throughout, and until which step as long as it is WITHOUT the child's literal. child
    [DEEP, C, 5], by KEY: go to LITERAL after waiting BEFORE steps, and STAY there (1) or not (0); or, with
    KEEP, go at once but keep that literal for the next BEFORE steps; or, with LITERAL -1, STAY that long
    where KEEP holds; or, without both, for a robot that cannot stay, make the motion STAY.
    """

    state: Ints
    need: Ints
    child: Ints


@leaf
def value(world: World, work: Work) -> float:
    """rho of a way that is complete."""
    for i in range(work.buffer.shape[0]):
        work.buffer[i] = work.known[i]
    work.spent[0] += world.cost
    return tree_value(world.agenda.rule.tree, work.buffer)


@leaf
def _add(nodes: Nodes, d: int, key: int, literal: int, before: int, stays: int, keep: int) -> None:
    """Adds a child to the node on depth d, in its place among those not tried yet."""
    i, child = nodes.state[d, COUNT], nodes.child
    if i == child.shape[1]:
        return
    nodes.state[d, COUNT] += 1
    while i > nodes.state[d, TRIED] and child[d, i - 1, KEY] > key:
        for c in range(child.shape[2]):
            child[d, i, c] = child[d, i - 1, c]
        i -= 1
    child[d, i, KEY], child[d, i, LITERAL], child[d, i, BEFORE] = key, literal, before
    child[d, i, STAY], child[d, i, KEEP] = stays, keep


@leaf
def _guard(world: World, k: int, s: int, stop: int, need: Ints, work: Work) -> bool:
    """Notes what has to hold until literal k does. Whether anything has to hold for a while."""
    agenda, guarding = world.agenda, False
    foresee(agenda, s, work.known, work.held, work.bounds.low, work.bounds.high)
    for g in range(need.shape[0]):
        need[g, WITHOUT] = -1
        if agenda.literal[g, 3] == 1 and g != k and not (need[g, BEGIN] <= s + 1 and need[g, UNTIL] >= stop):
            work.spent[0] += 2.0 * world.cost
            until = needed_without(agenda, g, k, s, stop, world.margin, work.bounds)
            if until > s:
                need[g, WITHOUT] = until
        guarding = guarding or need[g, UNTIL] >= 0 or need[g, WITHOUT] >= 0
    return guarding


@merged
def _expand(
    world: World, t: int, d: int, n: int, used: int, motions: Ints, poses: Floats, work: Work, nodes: Nodes
) -> bool:
    """Makes the node on depth d, of motions[:n]. Whether staying here satisfies the formula."""
    agenda, margin, steps, s, need = world.agenda, world.margin, motions.shape[0], t + n, nodes.need[d]
    state = nodes.state[d]
    state[MADE], state[USED], state[COUNT], state[TRIED], state[OPENED] = n, used, 0, 0, 0
    stay(world, t, n, steps, motions, poses, work)
    work.spent[0] += 0.1 * (steps - n)
    if value(world, work) > margin:
        return True
    read_at(world, poses, n, work)
    foresee(agenda, s, work.known, work.held, work.bounds.low, work.bounds.high)
    x, y, theta = poses[n, 0], poses[n, 1], poses[n, 2]
    bits = 2.0 + math.log2(float(steps))
    for k in range(need.shape[0]):
        guess = nodes.need[d - 1, k, DUE] if d > 0 else NEVER  # most stay what they were
        by = due(agenda, k, s, guess, margin, work.bounds)
        work.spent[0] += (3.0 if by in (guess, NEVER) else bits) * world.cost
        need[k, DUE], need[k, BEGIN], need[k, UNTIL], need[k, WITHOUT] = by, NEVER, -1, -1
        if by != NEVER and agenda.literal[k, 3] == 1:
            work.spent[0] += bits * world.cost
            until = needed_until(agenda, k, s, by, margin, work.bounds)
            if until >= by:
                need[k, BEGIN], need[k, UNTIL] = by, until
    dwelling, dwell = -1, 0
    for k in range(need.shape[0]):
        by = need[k, DUE]
        if by == NEVER or not holds(world, k, work.rho):
            continue
        stays = stay_for(agenda, k, s, by, steps - n, margin, work.bounds)
        work.spent[0] += bits * world.cost
        if stays <= steps - n and (stays > 1 or (stays == 1 and need[k, BEGIN] == s + 1)):
            _add(nodes, d, SECOND + by, -1, 0, stays, k)
            if stays < steps - n:
                dwelling, dwell = k, stays
    for k in range(need.shape[0]):
        by, f = need[k, DUE], world.field[k, 0]
        if f < 0 or holds(world, k, work.rho):
            continue
        ahead = to_go_at(world.body, world.fields, f, x, y, theta)
        if not ahead - world.band < min(steps - n, by - s):
            continue
        if dwelling >= 0:
            _add(nodes, d, SECOND + min(by, LAST), k, dwell, 1, dwelling)
        if by == NEVER:
            _add(nodes, d, LAST + int(ahead), k, 0, 1, -1)
            continue
        _add(nodes, d, FIRST + by, k, 0, 1, -1)
        late = by - s - math.ceil(ahead) - SPARE
        if late > 1:
            _add(nodes, d, LATER + by, k, late, 1, -1)
    if not world.stands and n < steps:
        for m in range(world.body.translate.shape[0]):
            _add(nodes, d, ANY, -1, 0, m, -1)
    return False


@merged
def _serve(
    world: World, t: int, d: int, c: int, motions: Ints, poses: Floats, work: Work, nodes: Nodes
) -> int:
    """Makes child c of the node on depth d: how many motions there are then, -1 where it leads nowhere."""
    agenda, margin, steps, need = world.agenda, world.margin, motions.shape[0], nodes.need[d]
    made, child = nodes.state[d, MADE], nodes.child[d, c]
    k, before, stays, keep = child[LITERAL], child[BEFORE], child[STAY], child[KEEP]
    n = made
    if k < 0 and keep < 0:
        read_at(world, poses, n, work)
        move(world, t, n, stays, motions, poses, work)
        n += 1
    elif k < 0:
        _guard(world, keep, t + n, t + steps, need, work)
        linger(world, keep, t, n, n + stays, need, motions, poses, work)
        n += stays
    else:
        by = need[k, DUE]
        stop = min(steps, by - t)
        guarding = _guard(world, k, t + n, t + stop, need, work) or keep >= 0
        arrived, begin, until = -1, 0, 0
        if keep >= 0:
            begin, until = need[keep, BEGIN], need[keep, UNTIL]
            need[keep, BEGIN], need[keep, UNTIL] = t + n + 1, t + n + before
        elif before > 0:
            linger(world, k, t, n, n + before, need, motions, poses, work)
            n += before
            arrived = n if holds(world, k, work.rho) else -1
        guarding = guarding and world.field[k, 0] != world.field[k, 1]
        for column in range(1, -1, -1):
            f = world.field[k, column]
            if arrived < 0 and f >= 0 and (column == 0 or guarding):
                waits = (column == 0 or keep >= 0) and world.stands
                arrived = walk(world, k, f, waits, t, n, stop, need, motions, poses, work)
                if arrived < 0:  # it came too late, or got stuck: look at more than one way
                    arrived = beam(world, k, f, t, n, stop, 0.0, 0, LENGTH, need, motions, poses, work)
        if keep >= 0:
            need[keep, BEGIN], need[keep, UNTIL] = begin, until
        if arrived < 0:
            return -1
        n = arrived
        if by != NEVER and stays == 1:
            foresee(agenda, t + n, work.known, work.held, work.bounds.low, work.bounds.high)
            stays = stay_for(agenda, k, t + n, by, steps - n, margin, work.bounds)
            work.spent[0] += 8.0 * world.cost
            if 0 < stays <= steps - n:
                if before == 0:  # or wait first and go there when it counts, or go on before it is served
                    _add(nodes, d, SECOND + by, k, stays if world.stands else n - made + stays, 1, -1)
                    _add(nodes, d, LATER + by, k, 0, 0, -1)
                linger(world, k, t, n, n + stays, need, motions, poses, work)
                n += stays
    foresee(agenda, t + n, work.known, work.held, work.bounds.low, work.bounds.high)
    work.spent[0] += world.cost
    return n if is_open(agenda, -1, t + n, 0, 0, 0, margin, work.bounds) else -1


@leaf
def search(
    world: World, t: int, n: int, effort: float, motions: Ints, poses: Floats, work: Work, nodes: Nodes
) -> bool:
    """A way to the horizon that satisfies the formula, on from motions[:n], into motions (T - t,) and
    poses (T - t + 1, 3), which begins with x_t. work.known: the leaves to step t + n. effort [about us].
    """
    state, most = nodes.state, work.spent[0] + effort
    limit, cut = 0, True  # discrepancies allowed, and whether ways with more were left out
    d, made, used = -1, n, 0
    while True:
        if made >= 0:
            d += 1
            if _expand(world, t, d, made, used, motions, poses, work, nodes):
                return True
            made = -1
        more = state[d, TRIED] < state[d, COUNT]
        if more and work.spent[0] > most:
            return False
        if not more or state[d, USED] + state[d, OPENED] > limit or d + 1 == DEEP:
            cut = cut or more
            d -= 1
            if d < 0:
                if not cut:
                    return False
                limit, cut, made, used = limit + 1, False, n, 0
            continue
        state[d, TRIED] += 1
        after = _serve(world, t, d, state[d, TRIED] - 1, motions, poses, work, nodes)
        if after > state[d, MADE]:
            made, used = after, state[d, USED] + state[d, OPENED]
            state[d, OPENED] += 1
