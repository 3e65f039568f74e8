"""Which regions a rule asks to visit, and which to avoid."""

from __future__ import annotations

from specshield.stl import BODY_WORDS, Formula, Implies, Not, body_name


def is_avoided(formula: Formula, region: str) -> bool:
    """Whether the formula asks the robot not to be in this region, or not to touch it."""
    return bool(avoided(formula) & {region, *(body_name(how, region) for how in BODY_WORDS)})


def avoided(formula: Formula, negated: bool = False) -> set[str]:
    """The names that the formula asks not to hold: those below an odd number of negations."""
    if isinstance(formula, Not):
        return avoided(formula.child, not negated)
    if isinstance(formula, Implies):
        return avoided(formula.left, not negated) | avoided(formula.right, negated)
    below = [part for part in formula.parts if isinstance(part, Formula)]
    if not below:
        return set(formula.names) if negated else set()
    return set().union(*(avoided(part, negated) for part in below))
