"""The windows of a rule on the time line: the steps at which its temporal operators look."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from specshield.stl import Always, Eventually, Formula, Until

LETTERS: dict[type[Formula], str] = {Always: "G", Eventually: "F", Until: "U"}


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
