"""The search for a way that satisfies a formula: go to where a literal holds, stay, go on.

A node of the search is a simulated prefix. Each child serves one literal: it goes to where the literal holds
and stays until the literal is no longer due. The literal that is due first comes first. A robot that cannot
stay moves about near there, and the last children of its nodes are its single motions. A child is cut if its
upper bound on rho is not above the margin. A node from which staying to the horizon satisfies the formula
ends the search.

The order of the children is nearly always right, so the search first tries the ways that depart least from it
(limited discrepancy search, Harvey and Ginsberg 1995). Its effort is counted, not timed: the same question
always has the same answer.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from specshield.arrays import Ints, copy_row
from specshield.compiled import inlined, leaf
from specshield.policy.planner.approach import BEAM_LENGTH, descend, descend_by_beam, linger
from specshield.policy.planner.due_dates import NO_DATE, due_date, foresee, is_open, needed_until, stay_for
from specshield.policy.planner.fields import to_go_at
from specshield.policy.planner.literals import GUARDS
from specshield.policy.planner.way import (
    BEGIN,
    DUE,
    UNTIL,
    UNTIL_GOAL,
    Way,
    World,
    holds,
    move,
    read_at,
    stay,
)
from specshield.robot.dynamics import motion_count
from specshield.stl.tree import tree_value

MAX_DEPTH = 128  # nodes on one way
SPARE = 3  # [steps] that a late departure leaves over; chosen by hand, nothing measured

MADE, COUNT, TRIED, OPENED, USED = range(5)  # the columns of a node's state
KEY, LITERAL, BEFORE, STAY, KEEP = range(5)  # the columns of a child
# The key that orders children: their class, plus the step at which the literal is due.
AT_ONCE, STAYING, LATER, NOT_DUE, SINGLE = 0, 1 << 20, 1 << 21, 1 << 22, 1 << 23


class Nodes(NamedTuple):
    """The nodes from the root to the newest.

    state [MAX_DEPTH, 5]: motions MADE, COUNT of children, how many were TRIED, how many of those were OPENED,
    discrepancies USED. need [MAX_DEPTH, L, 4]: what is needed of each literal, see way.py.

    child [MAX_DEPTH, C, 5], in the order of KEY, is one of four kinds. With LITERAL alone: wait BEFORE
    steps, go to the literal, and STAY there (1) or not (0). With LITERAL and KEEP: go at once, but keep the
    literal KEEP for the next BEFORE steps. With KEEP alone: STAY so many steps where KEEP holds. With
    neither, for a robot that cannot stay: make the motion STAY. What a child does not have is -1.
    """

    state: Ints
    need: Ints
    child: Ints


@leaf
def value(world: World, way: Way) -> float:
    """rho of a way that is complete."""
    copy_row(way.known, way.buffer)
    way.spent[0] += world.cost
    return tree_value(world.literals.formula.tree, way.buffer)


@leaf
def _foresee(world: World, way: Way, n: int) -> None:
    """Writes the leaves' bounds after motions[:n] into way.bounds."""
    foresee(world.literals, way.t + n, way.known, way.held, way.bounds)


@leaf
def _add(nodes: Nodes, d: int, key: int, literal: int, before: int, stays: int, keep: int) -> None:
    """Adds a child to the node at depth d, in the order of KEY among those not tried yet."""
    i, child = nodes.state[d, COUNT], nodes.child
    if i == child.shape[1]:
        return
    nodes.state[d, COUNT] += 1
    while i > nodes.state[d, TRIED] and child[d, i - 1, KEY] > key:
        copy_row(child[d, i - 1], child[d, i])
        i -= 1
    child[d, i, KEY], child[d, i, LITERAL], child[d, i, BEFORE] = key, literal, before
    child[d, i, STAY], child[d, i, KEEP] = stays, keep


@leaf
def guard(world: World, way: Way, k: int, n: int, stop: int, need: Ints) -> bool:
    """Writes into need (L, 4) what has to hold from motions[:n] on, at most to step `stop`, until literal k
    does. Returns whether anything has to hold for a while.
    """
    literals, guarding, s = world.literals, False, way.t + n
    _foresee(world, way, n)
    for g in range(need.shape[0]):
        need[g, UNTIL_GOAL] = -1
        throughout = need[g, BEGIN] <= s + 1 and need[g, UNTIL] >= stop
        if literals.literal[g, GUARDS] == 1 and g != k and not throughout:
            way.spent[0] += 2.0 * world.cost
            until = needed_until(literals, g, s, s + 1, stop, k, way.bounds)
            if until > s:
                need[g, UNTIL_GOAL] = until
        guarding = guarding or need[g, UNTIL] >= 0 or need[g, UNTIL_GOAL] >= 0
    return guarding


@inlined
def _expand(world: World, way: Way, nodes: Nodes, d: int, n: int, used: int) -> bool:
    """Makes the node at depth d, of motions[:n]. Returns whether staying here satisfies the formula."""
    literals, steps, s, need = world.literals, way.motions.shape[0], way.t + n, nodes.need[d]
    state = nodes.state[d]
    state[MADE], state[USED], state[COUNT], state[TRIED], state[OPENED] = n, used, 0, 0, 0
    stay(world, way, n, steps)
    way.spent[0] += 0.1 * (steps - n)
    if value(world, way) > literals.margin:
        return True
    read_at(world, way, n)
    _foresee(world, way, n)
    bits = 2.0 + math.log2(float(steps))
    for k in range(need.shape[0]):
        guess = nodes.need[d - 1, k, DUE] if d > 0 else NO_DATE  # most due dates stay what they were
        by = due_date(literals, k, s, guess, way.bounds)
        way.spent[0] += (3.0 if by in (guess, NO_DATE) else bits) * world.cost
        need[k, DUE], need[k, BEGIN], need[k, UNTIL], need[k, UNTIL_GOAL] = by, NO_DATE, -1, -1
        if by != NO_DATE and literals.literal[k, GUARDS] == 1:
            way.spent[0] += bits * world.cost
            until = needed_until(literals, k, s, by, NO_DATE, -1, way.bounds)
            if until >= by:
                need[k, BEGIN], need[k, UNTIL] = by, until
    dwelling, dwell = -1, 0
    for k in range(need.shape[0]):
        by = need[k, DUE]
        if by == NO_DATE or not holds(world, k, way.rho):
            continue
        stays = stay_for(literals, k, s, by, steps - n, way.bounds)
        way.spent[0] += bits * world.cost
        if stays <= steps - n and (stays > 1 or (stays == 1 and need[k, BEGIN] == s + 1)):
            _add(nodes, d, STAYING + by, -1, 0, stays, k)
            if stays < steps - n:
                dwelling, dwell = k, stays
    for k in range(need.shape[0]):
        by, f = need[k, DUE], world.field[k, 0]
        if f < 0 or holds(world, k, way.rho):
            continue
        ahead = to_go_at(world.body, world.fields, f, way.poses[n, 0], way.poses[n, 1], way.poses[n, 2])
        ahead = 0.0 if ahead == math.inf and world.barred.shape[0] > 0 else ahead  # the way out may be barred
        if not ahead - world.band < min(steps - n, by - s):
            continue
        if dwelling >= 0:
            _add(nodes, d, STAYING + min(by, NOT_DUE), k, dwell, 1, dwelling)
        if by == NO_DATE:
            _add(nodes, d, NOT_DUE + int(ahead), k, 0, 1, -1)
            continue
        _add(nodes, d, AT_ONCE + by, k, 0, 1, -1)
        late = by - s - math.ceil(ahead) - SPARE
        if late > 1:
            _add(nodes, d, LATER + by, k, late, 1, -1)
    if not world.stands and n < steps:
        for m in range(motion_count(world.body)):
            _add(nodes, d, SINGLE, -1, 0, m, -1)
    return False


@inlined
def _serve(world: World, way: Way, nodes: Nodes, d: int, c: int) -> int:
    """Makes child c of the node at depth d. Returns how many motions there are then, -1 if it is cut."""
    literals, steps, need = world.literals, way.motions.shape[0], nodes.need[d]
    made, child = nodes.state[d, MADE], nodes.child[d, c]
    k, before, stays, keep = child[LITERAL], child[BEFORE], child[STAY], child[KEEP]
    n = made
    if k < 0 and keep < 0:
        read_at(world, way, n)
        move(world, way, n, stays)
        n += 1
    elif k < 0:
        guard(world, way, keep, n, way.t + steps, need)
        linger(world, way, keep, n, n + stays, need)
        n += stays
    else:
        by = need[k, DUE]
        stop = min(steps, by - way.t)
        guarding = guard(world, way, k, n, way.t + stop, need) or keep >= 0
        arrived, begin, until = -1, 0, 0
        if keep >= 0:
            begin, until = need[keep, BEGIN], need[keep, UNTIL]
            need[keep, BEGIN], need[keep, UNTIL] = way.t + n + 1, way.t + n + before
        elif before > 0:
            linger(world, way, k, n, n + before, need)
            n += before
            arrived = n if holds(world, k, way.rho) else -1
        guarding = guarding and world.field[k, 0] != world.field[k, 1]
        for column in range(1, -1, -1):
            f = world.field[k, column]
            if arrived < 0 and f >= 0 and (column == 0 or guarding):
                waits = (column == 0 or keep >= 0) and world.stands
                arrived = descend(world, way, k, f, waits, n, stop, need)
                if arrived < 0:  # it came too late or got stuck: a beam looks at more than one way
                    arrived = descend_by_beam(world, way, k, f, n, stop, 0.0, (0, BEAM_LENGTH), need)
        if keep >= 0:
            need[keep, BEGIN], need[keep, UNTIL] = begin, until
        if arrived < 0:
            return -1
        n = arrived
        if by != NO_DATE and stays == 1:
            _foresee(world, way, n)
            stays = stay_for(literals, k, way.t + n, by, steps - n, way.bounds)
            way.spent[0] += 8.0 * world.cost
            if 0 < stays <= steps - n:
                if before == 0:  # other ways: to wait first and go there when it counts, or not to stay
                    _add(nodes, d, STAYING + by, k, stays if world.stands else n - made + stays, 1, -1)
                    _add(nodes, d, LATER + by, k, 0, 0, -1)
                linger(world, way, k, n, n + stays, need)
                n += stays
    _foresee(world, way, n)
    way.spent[0] += world.cost
    return n if is_open(literals, way.bounds) else -1


@leaf
def search(world: World, way: Way, nodes: Nodes, n: int, effort: float) -> bool:
    """Goes on from motions[:n] to the horizon so that the formula is satisfied; returns whether that is
    found. way.known has to hold the leaves to step t + n. effort [about us].
    """
    state, most = nodes.state, way.spent[0] + effort
    limit, cut = 0, True  # how many discrepancies are allowed, and whether ways with more were left out
    d, made, used = -1, n, 0
    while True:
        if made >= 0:
            d += 1
            if _expand(world, way, nodes, d, made, used):
                return True
            made = -1
        more = state[d, TRIED] < state[d, COUNT]
        if more and way.spent[0] > most:
            return False
        if not more or state[d, USED] + state[d, OPENED] > limit or d + 1 == MAX_DEPTH:
            cut = cut or more
            d -= 1
            if d < 0:
                if not cut:
                    return False
                limit, cut, made, used = limit + 1, False, n, 0
            continue
        state[d, TRIED] += 1
        after = _serve(world, way, nodes, d, state[d, TRIED] - 1)
        if after > state[d, MADE]:
            made, used = after, state[d, USED] + state[d, OPENED]
            state[d, OPENED] += 1
