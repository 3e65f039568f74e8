"""What is wrong with a rule that cannot be kept from here: its conjuncts, each alone and beside the others.

Futures are gathered from the policies and from a search (search.py): for each conjunct alone, and for all of
them while one may be late. They are simulated with f and measured. Whatever is said of a conjunct is shown by
some future.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.caution.residual import all_of
from specshield.reasons.ground import Ground, make_ground
from specshield.reasons.known import Known
from specshield.reasons.lateness import driven, later, may_be_late, values_of
from specshield.reasons.search import MOST_NODES, search
from specshield.reasons.smaller import STEP, kept_out, most_steps, smaller
from specshield.robot.dynamics import calmest_motion
from specshield.shield.decision import Shield
from specshield.shield.feasibility import futures, prefix_of
from specshield.shield.proposal import adapted
from specshield.stl import SATISFIED_ABOVE, Always, Formula, conjuncts
from specshield.stl.conjunction import is_predicate
from specshield.task import MAX_HORIZON, Task
from specshield.world.regions import Region

MOST_LATE = 150  # [steps] the most by which a window is tried to end later. Chosen by hand
MOST_PROBED, PROBE = 100_000, 20_000  # poses in searches for later ends: in all, and in one. By hand
MOST_CONJUNCTS = 8  # that are searched for; further ones are judged by the policies' futures alone


class Conjunct(NamedTuple):
    """One conjunct of a rule that cannot be kept.

    feasible_alone: whether a future was found that keeps it, whatever becomes of the others. robustness: the
    highest found [m], among the futures that keep all other conjuncts if there are any and it is feasible
    alone, else among all; -inf if nothing was tried. late, smaller: what would do for the whole rule if it is
    feasible alone, else for the conjunct alone; None if nothing was found that is enough.
    """

    formula: Formula
    feasible_alone: bool
    robustness: float
    late: Late | None
    smaller: Smaller | None


class Late(NamedTuple):
    """By how many steps a window would have to end later, or that of a G over a predicate to begin later.
    only: whether that is all that the whole rule lacks.
    """

    steps: int
    only: bool


class Smaller(NamedTuple):
    """By how much [m] the regions of a keep-out would have to be smaller all round, and the regions as they
    would then be. only: as of `Late`.
    """

    by: float
    regions: dict[str, Region]
    only: bool


class Relaxed(NamedTuple):
    """conjuncts: of the rule. tried: how many futures were judged. way: the motions, one a byte, of a future
    that keeps the rule, which the policies did not find.
    """

    conjuncts: tuple[Conjunct, ...]
    tried: int
    way: bytes | None


def relaxations(
    shield: Shield, history: Floats, signals: Mapping[str, Floats], longest: int = MAX_HORIZON
) -> Relaxed:
    """What of a rule that reads something cannot be kept after x_0..x_t, history [t + 1, 3], signals
    {name: [t + 1]}. longest: the longest horizon that a rule may have there [steps].
    """
    gathered = _Gathered(shield, Known(shield.task, history, signals), conjuncts(shield.task.formula))
    late, shrunk = _gather(gathered, longest)
    rho = np.concatenate(gathered.rho, axis=1)
    keeps = rho > SATISFIED_ABOVE
    each = enumerate(gathered.parts)
    told = tuple(_told(part, i, rho, keeps, late.get(i), shrunk.get(i)) for i, part in each)
    return Relaxed(told, rho.shape[1], gathered.way)


def way(shield: Shield, history: Floats, signals: Mapping[str, Floats]) -> Ints | None:
    """Motions from x_t to the horizon that satisfy the formula, if a search finds some without policies."""
    known = Known(shield.task, history, signals)
    if not shield.task.formula.names:  # as in `relaxations`
        return None
    return _Searched(shield, known, make_ground(shield.task, shield.body, known.held)).way(shield.task)


def _told(
    part: Formula, i: int, rho: Floats, keeps: Bools, late: Late | None, shrunk: Smaller | None
) -> Conjunct:
    """rho, keeps [conjuncts, futures]. A future for another conjunct may show only now that this one can be
    kept alone: what was found to be enough for that is no longer told then.
    """
    beside = np.delete(keeps, i, axis=0).all(axis=0)
    alone = bool(keeps[i].any())
    highest = float(rho[i][beside].max() if alone and beside.any() else rho[i].max())
    late = late if late and (late.only or not alone) else None
    shrunk = shrunk if shrunk and (shrunk.only or not alone) else None
    return Conjunct(part, alone, highest, late, shrunk)


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
    longest: int = MAX_HORIZON  # horizon of a rule [steps]
    looked_at: int = 0  # by the last search

    def task(self, formula: Formula, regions: Mapping[str, Region] | None = None) -> Task:
        """The task with another formula, and with some other regions."""
        task = self.shield.task
        return replace(task, formula=formula, regions={**task.regions, **(regions or {})})

    def way(self, task: Task, most: int = MOST_NODES) -> Ints | None:
        """Motions from x_t to the task's horizon that keep it, if a search of some `most` poses finds any."""
        ground = self.ground
        if task.regions != ground.task.regions:
            ground = replace(ground, task=task, kept={})
        found, self.looked_at = search(replace(self.known, task=task), ground, self.shield.body, most)
        return found if found is not None and self.keeps(found, task) else None

    def keeps(self, motions: Ints, task: Task) -> bool:
        """Whether motions [m] from x_t satisfy the task's formula."""
        poses = driven(self.shield, self.known.history, motions[None])
        whole = replace(task, formula=self.shield.task.formula)  # a conjunct may read nothing
        return float(values_of(task.formula, whole.samples(poses, self.known.signals))[0]) > SATISFIED_ABOVE

    def probe(self, task: Task) -> Ints | None:
        """`way`, as long as some of `probes` are left."""
        if self.probes <= 0:
            return None
        way = self.way(task, min(self.probes, PROBE))
        self.probes -= self.looked_at
        return way

    def least(self, first: int, most: int, change: Callable[[int], Task]) -> tuple[int, Ints] | None:
        """The least change, of 1 to `most` steps, for which the search finds a way that keeps the task that
        it makes; and the way. So the same search finds it if that task is asked for. first: of all tries.
        """
        low, high, best = 0, first, None
        while best is None and low < most:
            high = min(high, most)
            best = self.probe(change(high))
            low, high = (low, high) if best is not None else (high, 2 * high)
        while best is not None and high - low > 1:
            tried, under = low, high  # the way may do with a smaller change
            while under - tried > 1:
                middle = (tried + under) // 2
                tried, under = (tried, middle) if self.keeps(best, change(middle)) else (middle, under)
            tried = under if under < high else (low + high) // 2
            way = self.probe(change(tried))
            low, high, best = (tried, high, best) if way is None else (low, tried, way)
        return None if best is None else (high, best)

    def soonest(self, parts: Sequence[Formula], i: int) -> tuple[int, Ints] | None:
        """By how many steps, at least, the window of part i has to end later for all parts to be kept."""
        return self.least(
            1, _most_late(parts[i], self.longest), lambda late: self.task(_eased(parts, i, late))
        )

    def smallest(self, parts: Sequence[Formula], i: int) -> tuple[Smaller, Ints] | None:
        """By how much, at least, the regions that part i keeps out of have to be smaller for the same. Those
        that do not matter stay as they are.
        """
        regions = self.shield.task.regions
        out = {name: most_steps(regions[name]) for name in kept_out(parts[i], regions)}
        most = {name: steps for name, steps in out.items() if steps > 0}

        def at(steps: int, names: Iterable[str]) -> dict[str, Region]:
            found = {name: smaller(regions[name], min(steps, most[name])) for name in names}
            return {name: region for name, region in found.items() if region is not None}

        def changed(steps: int, names: Iterable[str] = most) -> Task:
            return self.task(all_of(parts), at(steps, names))

        largest = max(most.values(), default=0)
        found = self.least(largest, largest, changed)
        if found is None:
            return None
        steps, way = found
        needed = [each for each in most if not self.keeps(way, changed(steps, most.keys() - {each}))]
        alone = self.probe(changed(steps, needed)) if 0 < len(needed) < len(most) else None
        names, way = (most, way) if alone is None else (needed, alone)
        return Smaller(round(steps * STEP, 2), at(steps, names), True), way


def _most_late(part: Formula, longest: int) -> int:
    """By how many steps a window is tried to end later, or that of a G over a predicate to begin later."""
    begins = isinstance(part, Always) and is_predicate(part.child)
    return part.b - part.a if isinstance(part, Always) and begins else min(MOST_LATE, longest - part.horizon)


def _gather(gathered: _Gathered, longest: int) -> tuple[dict[int, Late], dict[int, Smaller]]:
    """Judges the policies' futures, then, as far as these leave it open, searches for the whole rule, for
    each conjunct alone, which the policies are asked for too, for a later end of each conjunct's window, and
    for smaller regions of each keep-out.
    """
    shield, known, parts = gathered.shield, gathered.known, gathered.parts
    late, shrunk = dict[int, Late](), dict[int, Smaller]()
    prefix = prefix_of(shield.task, shield.task.formula, shield.view, known.history, known.signals)
    if prefix.steps > 0:
        gathered.judge(futures(prefix, shield.body, shield.proposers, None, (0.0,)).motions)
    gathered.judge(np.full((1, max(prefix.steps, 1)), calmest_motion(shield.body)))
    ground = make_ground(shield.task, shield.body, known.held)
    searched = _Searched(shield, known, ground, longest=longest)

    def look_for(formula: Formula) -> None:
        if (found := searched.way(searched.task(formula))) is not None:
            gathered.judge(found[None])

    if gathered.way is None:
        look_for(shield.task.formula)
    if gathered.way is not None:
        return late, shrunk
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
    whole = all(alone) or len(parts) == 1
    for i in some:
        if timed[i] and (whole or not alone[i]):
            found = searched.soonest(*((parts, i) if whole else (parts[i : i + 1], 0)))
            if found is not None:
                steps, motions = found
                late[i] = Late(
                    steps, whole or searched.way(searched.task(_eased(parts, i, steps))) is not None
                )
                gathered.judge(motions[None])
        elif all(alone) and len(parts) > 1:
            look_for(all_of([other for other in parts if other != parts[i]]))
    searched.probes = MOST_PROBED
    for i in some:
        if whole or not alone[i]:
            least = searched.smallest(*((parts, i) if whole else (parts[i : i + 1], 0)))
            if least is not None:
                less, motions = least
                only = whole or searched.way(searched.task(shield.task.formula, less.regions)) is not None
                shrunk[i] = less._replace(only=only)
                gathered.judge(motions[None])
    return late, shrunk


def _eased(parts: Sequence[Formula], i: int, late: int) -> Formula:
    """All parts, the window of the one ending so many steps later."""
    return all_of([*parts[:i], later(parts[i], late) or parts[i], *parts[i + 1 :]])
