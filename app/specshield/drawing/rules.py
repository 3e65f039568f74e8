"""What a picture shows of a rule: the regions that it asks to avoid, and its windows on the time line."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from specshield.stl import BODY_WORDS, Always, Eventually, Formula, Implies, Not, Until, body_name

LETTERS: dict[type[Formula], str] = {Always: "G", Eventually: "F", Until: "U"}


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


class Window(NamedTuple):
    """operator: G, F or U. begin, end: the first and the last step at which `formula` may look, from the
    rule's origin on. depth: the number of other windows that contain this one.
    """

    operator: str
    formula: str
    begin: int
    end: int
    depth: int


def windows(formula: Formula, begin: int = 0, end: int = 0, depth: int = 0) -> Iterator[Window]:
    """The windows, outermost first. An operator inside another one counts from each step of the outer window.

    >>> from specshield.stl import parse
    >>> [(w.operator, w.begin, w.end) for w in windows(parse("F[2,5] G[0,3] a and G[0,9] b"))]
    [('F', 2, 5), ('G', 2, 8), ('G', 0, 9)]
    """
    inner = begin
    if isinstance(formula, (Always, Eventually, Until)):
        begin, end = begin + formula.a, end + formula.b
        yield Window(LETTERS[type(formula)], str(formula), begin, end, depth)
        depth += 1
        inner = begin if not isinstance(formula, Until) else begin - formula.a
    for i, part in enumerate(formula.parts):
        if isinstance(part, Formula):  # the left side of an `until` holds from t on, not from t + a
            yield from windows(part, inner if i == 0 else begin, end, depth)
