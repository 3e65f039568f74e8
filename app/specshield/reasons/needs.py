"""What keeping a formula needs of a trajectory: predicates that have to hold within windows of steps.

Every trajectory that satisfies the formula meets all needs of at least one of its alternatives. The converse
is not true: what is hard to say as a need is left out. So if no trajectory can meet the needs of any
alternative, none satisfies the formula.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import product

from specshield.stl import Always, And, Eventually, Formula, Implies, Not, Or, Until
from specshield.stl.conjunction import is_predicate

MOST_ALTERNATIVES = 32  # with more, nothing is needed: each would have to be refuted by itself
MOST_INSTANTS = 8  # steps of a G at which an F below it is asked for


@dataclass(frozen=True)
class Need:
    """`predicate` holds at every step from s to s + stay, for some step s from `first` to `last`.

    part: the need as it stands in the formula, if part of its window is over. before: what has to hold at
    every step until then, as the left side of an until does.
    """

    predicate: Formula
    first: int
    last: int
    stay: int
    part: Formula | None = None
    before: Formula | None = None

    @property
    def end(self) -> int:
        """The last step that it may need."""
        return self.last + self.stay

    @property
    def formula(self) -> Formula:
        if self.part is not None:
            return self.part
        if self.first == self.last:
            return Always(self.first, self.end, self.predicate)
        stays = Always(0, self.stay, self.predicate) if self.stay else self.predicate
        return Eventually(self.first, self.last, stays)


Alternatives = tuple[tuple[Need, ...], ...]
NOTHING: Alternatives = ((),)
IMPOSSIBLE: Alternatives = ()


@dataclass(frozen=True)
class Reader:
    """Reads the needs out of formulas.

    now: the step up to which the trajectory is known. constant: given a predicate and a step, its truth if
    that is the same at every step from that one on, whatever the robot does; else None.
    """

    now: int
    constant: Callable[[Formula, int], bool | None]

    def alternatives(self, formula: Formula) -> Alternatives:
        """The alternatives of a formula at step 0; none where it cannot be satisfied."""
        return self._some(positive(formula), 0, 0)

    def from_step(self, left: Formula, step: int) -> Alternatives:
        """The alternatives of what is left of a formula (remainder.py) from a step on."""
        match left:
            case Or(children):
                return _any(self.from_step(child, step) for child in children)
            case And(children):
                return _all(self.from_step(child, step) for child in children)
            case Eventually(a, b, child):
                return self._some(child, max(a, step), b)
            case Always(a, b, child):
                return self._every(child, max(a, step), b)
            case Until(_, b, kept, child):
                then = self._some(child, step, b)
                if is_predicate(kept) and is_predicate(child):
                    then = tuple(tuple(replace(need, before=kept) for need in way) for way in then)
                return then
        return NOTHING

    def _some(self, formula: Formula, a: int, b: int) -> Alternatives:
        """What is needed for the formula to hold at some step from a to b."""
        if is_predicate(formula):
            return self._asked(Need(formula, a, b, 0, Eventually(a, b, formula) if b else formula))
        match formula:
            case Or(children):
                return _any(self._some(child, a, b) for child in children)
            case And(children):
                return _all(self._some(child, a, b) for child in children)
            case Eventually(c, d, child):
                return self._some(child, a + c, b + d)
            case Always(c, d, child) if is_predicate(child):
                return self._asked(Need(child, a + c, b + c, d - c))
            case Always(c, d, child) if a + d >= b + c:  # steps in the window for any step from a to b
                return self._every(child, b + c, a + d)
            case Always(c, d, child):
                return self._some(child, a + c, b + d)
            case Until(c, d, left, right):
                then = self._some(right, a + c, b + d)
                if a == b <= self.now + 1 and is_predicate(left) and is_predicate(right):
                    then = tuple(tuple(replace(need, before=left) for need in way) for way in then)
                return _all([then, self._every(left, a, a + c - 1)]) if a == b and c > 0 else then
        return NOTHING

    def _every(self, formula: Formula, a: int, b: int) -> Alternatives:
        """What is needed for the formula to hold at every step from a to b."""
        if is_predicate(formula):
            return self._asked(Need(formula, a, a, b - a))
        if a == b:
            return self._some(formula, a, b)
        match formula:
            case And(children):
                return _all(self._every(child, a, b) for child in children)
            case Or(children):
                start = max(a, min(self.now, b))
                truths = [self.constant(child, start) if is_predicate(child) else None for child in children]
                left = [child for child, truth in zip(children, truths, strict=True) if truth is None]
                if True in truths or len(left) > 1:
                    return NOTHING
                return self._every(left[0], start, b) if left else IMPOSSIBLE
            case Always(c, d, child):
                return self._every(child, a + c, b + d)
            case Eventually(c, d, child):
                apart = max(d - c + 1, -(-(b - a) // MOST_INSTANTS))
                return _all(self._some(child, s + c, s + d) for s in [*range(a, b, apart), b])
            case Until(c, d, left_side, right):
                then = self._every(Eventually(c, d, right), a, b)
                return _all([then, self._every(left_side, a, b + c - 1)]) if c > 0 else then
        return NOTHING

    def _asked(self, need: Need) -> Alternatives:
        truth = self.constant(need.predicate, need.first)
        if truth is not None:
            return NOTHING if truth else IMPOSSIBLE
        return ((need,),)


def _any(parts: Iterable[Alternatives]) -> Alternatives:
    found = tuple(dict.fromkeys(each for part in parts for each in part))
    return found if len(found) <= MOST_ALTERNATIVES else NOTHING


def _all(parts: Iterable[Alternatives]) -> Alternatives:
    found: Alternatives = NOTHING
    for part in parts:
        more = tuple(tuple(dict.fromkeys([*one, *other])) for one, other in product(found, part))
        found = found if len(more) > MOST_ALTERNATIVES else more
    return found


def positive(formula: Formula, negated: bool = False) -> Formula:
    """A formula of the same meaning (or of the opposite, where `negated`) in which `not` stands in front of
    single names, comparisons and `until` alone, and nothing is implied.
    """
    match formula:
        case Not(child):
            return positive(child, not negated)
        case Implies(left, right):
            return positive(Or((Not(left), right)), negated)
        case And(children) | Or(children):
            parts = tuple(positive(child, negated) for child in children)
            return And(parts) if isinstance(formula, And) is not negated else Or(parts)
        case Always(a, b, child) | Eventually(a, b, child):
            inner = positive(child, negated)
            always = isinstance(formula, Always) is not negated
            return Always(a, b, inner) if always else Eventually(a, b, inner)
        case Until(a, b, left, right):
            until = Until(a, b, positive(left), positive(right))
            return Not(until) if negated else until
    return Not(formula) if negated else formula
