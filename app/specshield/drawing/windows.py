"""The windows of a rule on the time line: when each of its temporal operators is looked at."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from specshield.stl import Always, Eventually, Formula, Until

LETTERS: dict[type[Formula], str] = {Always: "G", Eventually: "F", Until: "U"}


class Window(NamedTuple):
    """begin, end: the first and last step [steps from the session's start] that `formula` looks at.

    operator: G, F or U. depth: how many other windows it lies in.
    """

    operator: str
    formula: str
    begin: int
    end: int
    depth: int


def windows(formula: Formula, begin: int = 0, end: int = 0, depth: int = 0) -> Iterator[Window]:
    """Outermost first. An operator inside another one counts from each step of the outer window.

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
        if isinstance(part, Formula):  # the left of an `until` is looked at from the start of its window on
            yield from windows(part, inner if i == 0 else begin, end, depth)
