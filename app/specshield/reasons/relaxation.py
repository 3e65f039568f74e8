"""What is wrong with a rule that cannot be kept from here: its conjuncts, each alone and beside the others.

Futures are gathered from the policies and from a search (search.py): for each conjunct alone, and for all of
them while one may be late. They are simulated with f and measured. Whatever is said of a conjunct is shown by
some future.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.caution.residual import all_of
from specshield.reasons.course import Goal, course
from specshield.reasons.ground import Ground, make_ground
from specshield.reasons.known import Known
from specshield.reasons.lateness import driven, late_by, later, may_be_late, values_of
from specshield.reasons.needs import Alternatives, Need, Reader
from specshield.reasons.search import Wanted, search
from specshield.robot.dynamics import calmest_motion
from specshield.shield.decision import Shield
from specshield.shield.feasibility import futures, prefix_of
from specshield.shield.proposal import adapted
from specshield.stl import SATISFIED_ABOVE, Always, Formula, conjuncts

MOST_LATE = 150  # [steps] the most by which a window is tried to end later. Chosen by hand
MOST_TRIED = 3  # alternatives of one conjunct, or of all, that are searched for
MOST_CONJUNCTS = 8  # that are searched for; further ones are judged by the policies' futures alone


class Conjunct(NamedTuple):
    """One conjunct of a rule that cannot be kept.

    feasible_alone: whether a future was found that keeps it, whatever becomes of the others. robustness: the
    highest found [m], among the futures that keep all other conjuncts if there are any and it is feasible
    alone, else among all; -inf if nothing was tried. late_by: by how many steps its window would have to end
    later (that of a G over a predicate, to begin later), for the whole rule if it is feasible alone, else for
    the conjunct alone; None if no number was found that is enough. only: whether this is all that the whole
    rule lacks.
    """

    formula: Formula
    feasible_alone: bool
    robustness: float
    late_by: int | None
    only: bool = False


class Relaxed(NamedTuple):
    """conjuncts: of the rule. tried: how many futures were judged. way: the motions, one a byte, of a future
    that keeps the rule, which the policies did not find.
    """

    conjuncts: tuple[Conjunct, ...]
    tried: int
    way: bytes | None


def relaxations(shield: Shield, history: Floats, signals: Mapping[str, Floats]) -> Relaxed:
    """What of a rule that reads something cannot be kept after x_0..x_t, history [t + 1, 3], signals
    {name: [t + 1]}.
    """
    parts = conjuncts(shield.task.formula)
    gathered = _Gathered(shield, Known(shield.task, history, signals), parts)
    _gather(gathered)
    rho, late = np.concatenate(gathered.rho, axis=1), np.concatenate(gathered.late, axis=1)
    keeps = rho > SATISFIED_ABOVE
    told = tuple(_told(part, i, rho, late, keeps) for i, part in enumerate(parts))
    return Relaxed(told, rho.shape[1], gathered.way)


def way(shield: Shield, history: Floats, signals: Mapping[str, Floats]) -> Ints | None:
    """Motions from x_t to the horizon that satisfy the formula, if a search finds some without policies."""
    known, formula = Known(shield.task, history, signals), shield.task.formula
    if not formula.names:  # as in `relaxations`
        return None
    ground = make_ground(shield.task, shield.body, known.held)
    needed = Reader(known.now, known.constant).alternatives(formula)
    for found in _found(shield, known, ground, needed, ()):
        rho = values_of(formula, shield.task.samples(driven(shield, history, found), signals))
        if float(rho[0]) > SATISFIED_ABOVE:
            return np.asarray(found[0])
    return None


def _told(part: Formula, i: int, rho: Floats, late: Floats, keeps: Bools) -> Conjunct:
    """rho, late, keeps [conjuncts, futures]."""
    beside = np.delete(keeps, i, axis=0).all(axis=0)
    alone = bool(keeps[i].any())
    whole = float(late[i][beside].min(initial=np.inf))
    soonest = whole if alone else float(late[i].min())
    highest = float(rho[i][beside].max() if alone and beside.any() else rho[i].max())
    late_by = int(soonest) if 0.0 < soonest < np.inf else None
    return Conjunct(part, alone, highest, late_by, late_by is not None and soonest == whole)


@dataclass
class _Gathered:
    """Futures, by what each of them says of the conjuncts.

    rho: arrays [conjuncts, n], each for n futures [m]. late: arrays of the same shapes: by how many steps
    each comes too late, 0 if it keeps the conjunct, inf if no later end of the window is enough.
    """

    shield: Shield
    known: Known
    parts: tuple[Formula, ...]
    rho: list[Floats] = field(default_factory=list)
    late: list[Floats] = field(default_factory=list)
    way: bytes | None = None  # the first that keeps every conjunct

    def judge(self, motions: Ints) -> None:
        """motions [n, m]: from x_t to the horizon, or to some steps after it."""
        task, known = self.shield.task, self.known
        samples = task.samples(driven(self.shield, known.history, motions), known.signals)
        rows = [{name: values[n] for name, values in samples.items()} for n in range(len(motions))]
        rho = np.array([values_of(part, samples) for part in self.parts])
        keeps = np.flatnonzero((rho > SATISFIED_ABOVE).all(axis=0))
        if self.way is None and len(keeps):
            self.way = motions[keeps[0], : max(task.horizon - known.now, 0)].astype(np.uint8).tobytes()
        self.rho.append(rho)
        self.late.append(np.array([[_late(part, row, known.now) for row in rows] for part in self.parts]))

    def kept(self, i: int) -> bool:
        return any(bool((rho[i] > SATISFIED_ABOVE).any()) for rho in self.rho)


def _late(part: Formula, samples: Mapping[str, Floats], now: int) -> float:
    if float(values_of(part, samples)) > SATISFIED_ABOVE:
        return 0.0
    late = late_by(part, samples, now)
    return np.inf if late is None else float(late)


def _gather(gathered: _Gathered) -> None:
    """Judges the policies' futures, then, as far as these leave it open, searches for the whole rule, for
    each conjunct alone, which the policies are asked for too, and for all of them while one may be late or is
    left out.
    """
    shield, known, parts = gathered.shield, gathered.known, gathered.parts
    prefix = prefix_of(shield.task, shield.task.formula, shield.view, known.history, known.signals)
    if prefix.steps > 0:
        gathered.judge(futures(prefix, shield.body, shield.proposers, None, (0.0,)).motions)
    gathered.judge(np.full((1, max(prefix.steps, 1)), calmest_motion(shield.body)))
    ground = make_ground(shield.task, shield.body, known.held)
    reader = Reader(known.now, known.constant)

    def look_for(ways: Alternatives, late: Alternatives = ()) -> None:
        for found in _found(shield, known, ground, ways, late):
            gathered.judge(found)

    if gathered.way is None:
        look_for(reader.alternatives(shield.task.formula))
    if gathered.way is not None:
        return
    some = range(min(len(parts), MOST_CONJUNCTS))
    able = [policy for policy in shield.proposers if hasattr(policy, "giving_up")]
    each = [reader.alternatives(parts[i]) for i in some]
    driven = shield.task.samples(known.history, known.signals)
    timed = [later(parts[i], 1) is not None and may_be_late(parts[i], driven, known.now) for i in some]
    for i in some:
        if not gathered.kept(i):
            look_for(each[i])
        others = tuple(part for part in parts if part != parts[i])
        if able and others and prefix.steps > 0 and not gathered.kept(i):  # a search misses some rules
            asked = [adapted(policy, "giving_up", others) for policy in able]
            gathered.judge(futures(prefix, shield.body, asked, None, (0.0,)).motions)
        if not gathered.kept(i) and timed[i]:
            look_for(each[i], each[i])
    if len(parts) > 1 and all(gathered.kept(i) for i in range(len(parts))):
        for i in some:
            if timed[i]:
                look_for(reader.alternatives(shield.task.formula), each[i])
            else:
                look_for(reader.alternatives(all_of([other for other in parts if other != parts[i]])))


def _found(
    shield: Shield, known: Known, ground: Ground, ways: Alternatives, may_be_late: Alternatives
) -> Iterator[Ints]:
    """Futures [1, m] that meet the needs of some alternative; needs in `may_be_late` may be met later."""
    late = {need.formula for way in may_be_late for need in way}
    for needs in ways[:MOST_TRIED]:
        relaxed = [_relaxed(need) if need.formula in late else need for need in needs]
        asked = course(relaxed, known, ground, MOST_LATE if late else 0)
        if isinstance(asked, str):
            continue
        until = shield.task.horizon + (MOST_LATE if late else 0)
        wanted = [_want(goal, goal.need.formula in late) for goal in asked.goals[:MOST_CONJUNCTS]]
        found = search(known, ground, shield.body, asked.guards, wanted, until)
        if found is not None:
            yield found[None]


def _relaxed(need: Need) -> Need:
    """The same need, which may be met later; one that holds throughout a window may begin later in it."""
    if need.first == need.last and need.stay:
        return replace(need, last=need.end, stay=0, part=need.formula)
    return replace(need, last=need.last + MOST_LATE, part=need.formula)


def _want(goal: Goal, late: bool) -> Wanted:
    """What a search wants of a goal; of a guard, its first step alone, since guards are kept anyway."""
    need = wanted = goal.need
    if need.first == need.last:
        wanted = replace(need, stay=0)
    elif late and not isinstance(need.part, Always):
        wanted = replace(need, last=need.last - MOST_LATE)
    return Wanted(wanted, goal.far, need.last)
