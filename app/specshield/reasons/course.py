"""What is still to be done: the places to reach, in which windows, and what has to hold all the while."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats
from specshield.reasons.ground import Ground
from specshield.reasons.known import Known
from specshield.reasons.needs import Need, positive
from specshield.stl import SATISFIED_ABOVE, And, Formula

MOST_NEEDS = 24  # that are looked at; each is compared with all others


class Goal(NamedTuple):
    """A need, the squares where it may be met, and how far [m] each square is from them at least."""

    need: Need
    where: Bools
    far: Floats


class Course(NamedTuple):
    """guards: the needs that have to hold at every step of a window. goals: the needs that a way has to lead
    to, the smallest places first; they include guards whose window is still to come.
    """

    guards: tuple[Need, ...]
    goals: tuple[Goal, ...]


def course(needs: Sequence[Need], known: Known, ground: Ground) -> Course | str:
    """What these needs leave to be done after what is known, or why they cannot all be met."""
    pending: list[Need] = []
    for need in needs[:MOST_NEEDS]:
        left = need if need.first > known.now else _left(need, known.past(need.predicate), known.now)
        if left is False:
            return f"{need.formula} is broken already"
        if isinstance(left, Need):
            pending.append(left)
    return course_from(pending, known.now, ground)


def course_from(pending: Sequence[Need], now: int, ground: Ground) -> Course | str:
    """The same for needs that all begin after step `now`."""
    guards = tuple(need for need in pending if need.first == need.last)
    found: list[tuple[Need, Bools]] = []
    for need in pending:
        for asked in (need.predicate, _together(need, guards, need.last)):
            if not possible(asked, ground).any():
                return f"{need.formula} asks for '{asked}', which holds nowhere that the robot fits"
        where = possible(_together(need, guards, need.end), ground)
        begun = need.first == need.last == now + 1
        # A predicate that only may hold in every square is to be gone to: a square may lie across its edge.
        everywhere = not possible(positive(need.predicate, True), ground).any()
        if not begun and not everywhere:
            found.append((need, where))
    found = sorted(found, key=lambda goal: int(goal[1].sum()))
    return Course(
        guards, tuple(Goal(need, where, _far(need, where, guards, now, ground)) for need, where in found)
    )


def possible(predicate: Formula, ground: Ground) -> Bools:
    """The squares where a predicate may hold."""
    return np.asarray((ground.highest(predicate) > SATISFIED_ABOVE) & ground.free)


def _left(need: Need, past: Bools, now: int) -> Need | bool:
    """What is left of a need that has begun; True: it is, or may be, met; False: it is broken."""
    later, part = max(need.first, now + 1), need.formula
    if need.first == need.last:
        if not past[need.first : need.end + 1].all():
            return False
        return need.end < later or replace(need, first=later, last=later, stay=need.end - later, part=part)
    begun = any(past[s : s + need.stay + 1].all() for s in range(need.first, min(need.last, now) + 1))
    return begun or (later <= need.last and replace(need, first=later, part=part))


def _together(need: Need, guards: Sequence[Need], until: int) -> Formula:
    """The need's predicate and those of the guards that hold from its first step to step `until`."""
    parts: dict[Formula, None] = {}
    for each in [need, *(g for g in guards if g.first <= need.first and g.end >= until)]:
        inner = each.predicate
        parts |= dict.fromkeys(inner.children if isinstance(inner, And) else (inner,))
    return And(tuple(parts)) if len(parts) > 1 else next(iter(parts))


def _far(need: Need, where: Bools, guards: Sequence[Need], now: int, ground: Ground) -> Floats:
    """How far [m] each square is from the goal at least. Ways keep every guard that holds from the next step
    until the goal is reached. They may also lead through squares close by, since a guard says nothing of the
    way between two steps.
    """
    free, reach = ground.free, ground.travel
    for guard in guards:
        if guard.first <= now + 1 and guard.end >= need.last:
            free = free & (ground.highest(guard.predicate, reach / 2.0) > SATISFIED_ABOVE)
    if need.before is not None:  # the last step may leave where it holds
        free = free & (where | (ground.highest(need.before, reach) > SATISFIED_ABOVE))
    return ground.ways_to(where, free)
