"""What is left of a formula once its first steps are known, as a formula whose windows count from step 0.

What is left is True, False, or a formula. A window that is open begins at step 0, so what is left stays the
same as long as nothing is settled and no window opens or closes. Of two parts that ask for the same thing,
one of them for less, only the other is kept. An `until` that is left has begun: its left side has to hold
from the next step on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from specshield.reasons.needs import positive
from specshield.stl import Always, And, Eventually, Formula, Not, Or, Until
from specshield.stl.conjunction import is_predicate
from specshield.stl.formula import Windowed

Left = Formula | bool
Holds = Callable[[Formula], bool]


def after(left: Left, step: int, holds: Holds) -> Left:
    """What is left after one more step. left: what was left before it, in the form of `positive`. holds:
    whether a predicate holds at that step.
    """
    match left:
        case And(children) | Or(children):
            return _joined(isinstance(left, And), (after(child, step, holds) for child in children))
        case Not(child):  # of an `until`
            return _negated(after(child, step, holds))
        case Always(a, b, child) | Eventually(a, b, child):
            if step < a:
                return left
            every = isinstance(left, Always)
            further: Left = type(left)(0, b, child) if step < b else every
            return _joined(every, (_at(child, step, holds), further))
        case Until(_, b, kept, child):
            on = _joined(True, (_at(kept, step, holds), step < b and Until(0, b, kept, child)))
            return _joined(False, (_at(child, step, holds), on))
    return left


def begun(formula: Formula, holds: Holds) -> Left:
    """What is left of a formula after step 0."""
    return _at(positive(formula), 0, holds)


def next_change(left: Left, step: int) -> int:
    """The first step after this one at which a window opens or closes."""
    match left:
        case And(children) | Or(children):
            return min(next_change(child, step) for child in children)
        case Not(child):
            return next_change(child, step)
        case Windowed(a, b):
            return a if a > step else b
    return step + 1


def _at(formula: Formula, step: int, holds: Holds) -> Left:
    """What is left of a formula that is asked for at this step."""
    if is_predicate(formula):
        return holds(formula)
    match formula:
        case And(children) | Or(children):
            return _joined(isinstance(formula, And), (_at(child, step, holds) for child in children))
        case Not(child):
            return _negated(_at(child, step, holds))
        case Always(a, b, child) | Eventually(a, b, child):
            return after(type(formula)(step + a, step + b, child), step, holds)
        case Until(0, b, kept, child):
            return after(Until(0, step + b, kept, child), step, holds)
        case Until(a, b, kept, child):
            then = Eventually(step + a, step + a, Until(0, b - a, kept, child))
            return _joined(True, (after(Always(step, step + a - 1, kept), step, holds), then))
    raise TypeError(f"not in the form of `positive`: {formula}")


def _negated(left: Left) -> Left:
    return not left if isinstance(left, bool) else positive(left, True)


def implies(one: Left, other: Left) -> bool:
    """Whether whatever keeps the one keeps the other, as far as their forms show."""
    if one == other or one is False or other is True:
        return True
    match one, other:
        case _, And(children):
            return all(implies(one, child) for child in children)
        case Or(children), _:
            return all(implies(child, other) for child in children)
        case _, Or(children):
            return any(implies(one, child) for child in children)
        case And(children), _:
            return any(implies(child, other) for child in children)
        case Always(a, b, child), Always(c, d, same):
            return a <= c and d <= b and child == same
        case Eventually(a, b, child), Eventually(c, d, same):
            return c <= a and b <= d and child == same
    return False


def _joined(every: bool, parts: Iterable[Left]) -> Left:
    """The conjunction of the parts, or else their disjunction, without those that add nothing."""
    kind, kept = (And if every else Or), list[Formula]()
    for part in parts:
        if isinstance(part, bool):
            if part is not every:
                return part
            continue
        for each in part.children if isinstance(part, kind) else (part,):
            if not any(_adds_nothing(each, other, every) for other in kept):
                kept = [other for other in kept if not _adds_nothing(other, each, every)] + [each]
    if len(kept) < 2:
        return kept[0] if kept else every
    return kind(tuple(sorted(kept, key=str)))


def _adds_nothing(part: Formula, other: Formula, every: bool) -> bool:
    """Whether a part adds nothing beside another one of a conjunction, or else of a disjunction."""
    return implies(other, part) if every else implies(part, other)
