"""What is wrong with a rule that cannot be kept from here: its conjuncts, each alone and beside the others.

Futures are gathered from the policies and from a search (search.py): for each conjunct alone, and for all of
them while one may be late. They are simulated with f and measured. Whatever is said of a conjunct is shown by
some future.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.caution.residual import all_of
from specshield.reasons.ground import Ground, make_ground
from specshield.reasons.known import Known
from specshield.reasons.lateness import driven, later, may_be_late, values_of
from specshield.reasons.search import MOST_NODES, search
from specshield.robot.dynamics import calmest_motion
from specshield.shield.decision import Shield
from specshield.shield.feasibility import futures, prefix_of
from specshield.shield.proposal import adapted
from specshield.stl import SATISFIED_ABOVE, Always, Formula, conjuncts
from specshield.stl.conjunction import is_predicate

MOST_LATE = 150  # [steps] the most by which a window is tried to end later. Chosen by hand
MOST_PROBED, PROBE = 100_000, 20_000  # poses in searches for later ends: in all, and in one. By hand
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
    gathered = _Gathered(shield, Known(shield.task, history, signals), conjuncts(shield.task.formula))
    late = _gather(gathered)
    rho = np.concatenate(gathered.rho, axis=1)
    keeps = rho > SATISFIED_ABOVE
    told = tuple(_told(part, i, rho, keeps, late.get(i)) for i, part in enumerate(gathered.parts))
    return Relaxed(told, rho.shape[1], gathered.way)


def way(shield: Shield, history: Floats, signals: Mapping[str, Floats]) -> Ints | None:
    """Motions from x_t to the horizon that satisfy the formula, if a search finds some without policies."""
    known = Known(shield.task, history, signals)
    if not shield.task.formula.names:  # as in `relaxations`
        return None
    return _Searched(shield, known, make_ground(shield.task, shield.body, known.held)).way(
        shield.task.formula
    )


def _told(part: Formula, i: int, rho: Floats, keeps: Bools, late: Late | None) -> Conjunct:
    """rho, keeps [conjuncts, futures]."""
    beside = np.delete(keeps, i, axis=0).all(axis=0)
    alone = bool(keeps[i].any())
    highest = float(rho[i][beside].max() if alone and beside.any() else rho[i].max())
    return Conjunct(part, alone, highest, *(late or (None, False)))


class Late(NamedTuple):
    """By how many steps a window would have to end later; whether that is all that the whole rule lacks."""

    steps: int
    only: bool


@dataclass
class _Gathered:
    """Futures, by what each of them says of the conjuncts.

    rho: arrays [conjuncts, n], each for n futures [m].
    """

    shield: Shield
    known: Known
    parts: tuple[Formula, ...]
    rho: list[Floats] = field(default_factory=list)
    way: bytes | None = None  # the first that keeps every conjunct

    def judge(self, motions: Ints) -> None:
        """motions [n, m]: from x_t to the horizon, or to some steps after it."""
        task, known = self.shield.task, self.known
        lacks = max(task.horizon - known.now - motions.shape[1], 0)
        motions = np.pad(motions, ((0, 0), (0, lacks)), constant_values=calmest_motion(self.shield.body))
        samples = task.samples(driven(self.shield, known.history, motions), known.signals)
        rho = np.array([values_of(part, samples) for part in self.parts])
        keeps = np.flatnonzero((rho > SATISFIED_ABOVE).all(axis=0))
        if self.way is None and len(keeps):
            self.way = motions[keeps[0], : max(task.horizon - known.now, 0)].astype(np.uint8).tobytes()
        self.rho.append(rho)

    def kept(self, i: int) -> bool:
        return any(bool((rho[i] > SATISFIED_ABOVE).any()) for rho in self.rho)


@dataclass
class _Searched:
    """Searches for other formulas over the names of one task."""

    shield: Shield
    known: Known
    ground: Ground
    probes: int = MOST_PROBED  # poses that may still be looked at for later ends of windows
    looked_at: int = 0  # by the last search

    def way(self, formula: Formula, most: int = MOST_NODES) -> Ints | None:
        """Motions from x_t to the formula's horizon that satisfy it, if a search finds some. most: poses that
        it looks at.
        """
        task = replace(self.shield.task, formula=formula)
        found, self.looked_at = search(replace(self.known, task=task), self.ground, self.shield.body, most)
        if found is None:
            return None
        poses = driven(self.shield, self.known.history, found[None])
        rho = values_of(formula, self.shield.task.samples(poses, self.known.signals))
        return found if float(rho[0]) > SATISFIED_ABOVE else None

    def soonest(self, parts: Sequence[Formula], i: int) -> tuple[int, Ints] | None:
        """By how many steps, at least, the window of part i has to end later for a search to find a way that
        keeps all parts; and the way. So the same search finds that way if that rule is asked for.
        """

        def found(late: int) -> Ints | None:
            if self.probes <= 0:
                return None
            way = self.way(_eased(parts, i, late), min(self.probes, PROBE))
            self.probes -= self.looked_at
            return way

        most, low, high, best = _most_late(parts[i]), 0, 1, None
        while best is None and low < most:
            high = min(high, most)
            best = found(high)
            low, high = (low, high) if best is not None else (high, 2 * high)
        while best is not None and high - low > 1:
            middle = (low + high) // 2
            way = found(middle)
            low, high, best = (middle, high, best) if way is None else (low, middle, way)
        return None if best is None else (high, best)


def _most_late(part: Formula) -> int:
    """By how many steps a window is tried to end later, or that of a G over a predicate to begin later."""
    begins = isinstance(part, Always) and is_predicate(part.child)
    return part.b - part.a if isinstance(part, Always) and begins else MOST_LATE


def _gather(gathered: _Gathered) -> dict[int, Late]:
    """Judges the policies' futures, then, as far as these leave it open, searches for the whole rule, for
    each conjunct alone, which the policies are asked for too, and for a later end of each conjunct's window.
    """
    shield, known, parts, late = gathered.shield, gathered.known, gathered.parts, dict[int, Late]()
    prefix = prefix_of(shield.task, shield.task.formula, shield.view, known.history, known.signals)
    if prefix.steps > 0:
        gathered.judge(futures(prefix, shield.body, shield.proposers, None, (0.0,)).motions)
    gathered.judge(np.full((1, max(prefix.steps, 1)), calmest_motion(shield.body)))
    searched = _Searched(shield, known, make_ground(shield.task, shield.body, known.held))

    def look_for(formula: Formula) -> None:
        if (found := searched.way(formula)) is not None:
            gathered.judge(found[None])

    if gathered.way is None:
        look_for(shield.task.formula)
    if gathered.way is not None:
        return late
    some = range(min(len(parts), MOST_CONJUNCTS))
    able = [policy for policy in shield.proposers if hasattr(policy, "giving_up")]
    samples = shield.task.samples(known.history, known.signals)
    timed = [later(parts[i], 1) is not None and may_be_late(parts[i], samples, known.now) for i in some]
    for i in some:
        if not gathered.kept(i):
            look_for(parts[i])
        others = tuple(part for part in parts if part != parts[i])
        if able and others and prefix.steps > 0 and not gathered.kept(i):  # a search misses some rules
            asked = [adapted(policy, "giving_up", others) for policy in able]
            gathered.judge(futures(prefix, shield.body, asked, None, (0.0,)).motions)
    alone = [gathered.kept(i) for i in range(len(parts))]
    for i in some:
        if timed[i] and (all(alone) or not alone[i]):
            found = searched.soonest(parts, i) if all(alone) else searched.soonest(parts[i : i + 1], 0)
            if found is not None:
                steps, motions = found
                whole = all(alone) or len(parts) == 1 or searched.way(_eased(parts, i, steps)) is not None
                late[i] = Late(steps, whole)
                gathered.judge(motions[None])
        elif all(alone) and len(parts) > 1:
            look_for(all_of([other for other in parts if other != parts[i]]))
    return late


def _eased(parts: Sequence[Formula], i: int, late: int) -> Formula:
    """All parts, the window of the one ending so many steps later."""
    return all_of([*parts[:i], later(parts[i], late) or parts[i], *parts[i + 1 :]])
