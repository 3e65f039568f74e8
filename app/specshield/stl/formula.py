"""The nodes of an STL formula: frozen, hashable, and printed so that `parse(str(f)) == f`.

Terms are real-valued at each time step, formulas have a robustness at each time step. Windows are closed and
in whole steps; for `F`, `G` and `U` they are relative to the step at which the operator is evaluated.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import chain
from typing import Any, Literal

from specshield.errors import FormulaError

KEYWORDS = frozenset({"F", "G", "U", "not", "always", "eventually", "until", "and", "or", "implies", "abs"})
BODY_WORDS = ("touches", "inside")  # touches(R): some part of the footprint is in R; inside(R): all of it is
MAX_BOUND = 100_000  # steps; bounds the memory that a formula's samples take where no horizon limit is set

# How tightly each kind of expression binds. An operand that binds less tightly than its place asks is printed
# in parentheses.
IMPLIES, OR, AND, UNTIL, PREFIX, COMPARISON, SUM, PRODUCT, NEGATION, PRIMARY = range(1, 11)

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def is_name(text: str) -> bool:
    """Whether `text` can be a name in a formula: letters, digits and _, no digit in front, no keyword."""
    return _NAME.fullmatch(text) is not None and text not in KEYWORDS


def body_name(how: str, region: str) -> str:
    """The name under which a formula reads how the footprint lies to a region: `touches(Dock)`."""
    return f"{how}({region})"


def region_named(name: str) -> tuple[str | None, str]:
    """What a name asks of a region: `touches`, `inside` or None for the robot's origin, and the region."""
    how, opened, rest = name.partition("(")
    return (how, rest[:-1]) if opened else (None, name)


@dataclass(frozen=True)
class Node:
    """A term or a formula."""

    @cached_property
    def parts(self) -> tuple[Node, ...]:
        """The direct sub-nodes, left to right."""
        values = (getattr(self, field.name) for field in fields(self))
        joined = chain.from_iterable(value if isinstance(value, tuple) else (value,) for value in values)
        return tuple(part for part in joined if isinstance(part, Node))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names whose samples the node needs, sorted."""
        if isinstance(self, Name | Atom):
            return (self.name,)
        return tuple(sorted({name for part in self.parts for name in part.names}))

    @cached_property
    def depth(self) -> int:
        """The number of nodes on the longest way down, this one included."""
        return 1 + max((part.depth for part in self.parts), default=0)

    @property
    def binding(self) -> int:
        if isinstance(self, Arithmetic):
            return SUM if self.op in "+-" else PRODUCT
        return _BINDING.get(type(self), PRIMARY)

    def _at(self, binding: int) -> str:
        return str(self) if self.binding >= binding else f"({self})"


@dataclass(frozen=True)
class Term(Node):
    """Base of the nodes that are numbers at each step: numbers, names and arithmetic over them."""


@dataclass(frozen=True)
class Number(Term):
    value: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", float(self.value))
        if not math.isfinite(self.value):
            raise FormulaError("a number has to be finite", got=repr(self.value), expected="a finite number")

    def __str__(self) -> str:
        return repr(self.value).removesuffix(".0")


@dataclass(frozen=True)
class Name(Term):
    """The sampled value of a name: a region's signed distance, `touches` or `inside` of a region, a
    coordinate, a signal."""

    name: str

    def __post_init__(self) -> None:
        _check_name(self.name)

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class Neg(Term):
    child: Term

    def __str__(self) -> str:
        text = self.child._at(NEGATION)
        # `-3` parses as the number minus three, so the negated number three prints as `-(3)`.
        return f"-({text})" if isinstance(self.child, Number) and not text.startswith("-") else f"-{text}"


@dataclass(frozen=True)
class Abs(Term):
    child: Term

    def __str__(self) -> str:
        return f"abs({self.child})"


@dataclass(frozen=True)
class Arithmetic(Term):
    op: Literal["+", "-", "*", "/"]
    left: Term
    right: Term

    def __str__(self) -> str:
        return f"{self.left._at(self.binding)} {self.op} {self.right._at(self.binding + 1)}"


@dataclass(frozen=True)
class Formula(Node):
    """Base of the nodes that have a robustness rho at each step. A formula is satisfied where rho > 0."""

    @cached_property
    def horizon(self) -> int:
        """hrz: the last step whose samples the formula may need, counted from the step of evaluation."""
        below = (part.horizon for part in self.parts if isinstance(part, Formula))
        return self._reach + max(below, default=0)

    @property
    def _reach(self) -> int:
        return 0


@dataclass(frozen=True)
class Atom(Formula):
    """A name used as a truth value: rho is its sample, for a region the signed distance, positive inside."""

    name: str

    def __post_init__(self) -> None:
        _check_name(self.name)

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class Comparison(Formula):
    """rho is left - right for `>` and `>=`, right - left for `<` and `<=`."""

    op: Literal["<", "<=", ">", ">="]
    left: Term
    right: Term

    def __str__(self) -> str:
        return f"{self.left._at(SUM)} {self.op} {self.right._at(SUM)}"


@dataclass(frozen=True)
class Not(Formula):
    child: Formula

    def __str__(self) -> str:
        return f"not {self.child._at(PREFIX)}"


@dataclass(frozen=True)
class Joined(Formula):
    """Base of `and` and `or`, which join at least two formulas."""

    children: tuple[Formula, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "children", tuple(self.children))
        if (count := len(self.children)) < 2:
            raise FormulaError("'and' and 'or' join at least two formulas", got=count, expected="at least 2")


@dataclass(frozen=True)
class And(Joined):
    def __str__(self) -> str:
        return " and ".join(child._at(AND + 1) for child in self.children)


@dataclass(frozen=True)
class Or(Joined):
    def __str__(self) -> str:
        return " or ".join(child._at(OR + 1) for child in self.children)


@dataclass(frozen=True)
class Implies(Formula):
    left: Formula
    right: Formula

    def __str__(self) -> str:
        return f"{self.left._at(IMPLIES + 1)} -> {self.right._at(IMPLIES + 1)}"


@dataclass(frozen=True)
class Windowed(Formula):
    """Base of the temporal operators: their window is [a, b], 0 <= a <= b."""

    a: int
    b: int

    def __post_init__(self) -> None:
        _check_window(self.a, self.b)

    @property
    def _reach(self) -> int:
        return self.b


@dataclass(frozen=True)
class Always(Windowed):
    child: Formula

    def __str__(self) -> str:
        return f"G[{self.a},{self.b}] {self.child._at(PREFIX)}"


@dataclass(frozen=True)
class Eventually(Windowed):
    child: Formula

    def __str__(self) -> str:
        return f"F[{self.a},{self.b}] {self.child._at(PREFIX)}"


@dataclass(frozen=True)
class Until(Windowed):
    """left U[a,b] right: right at some t' in [t+a, t+b], and left at every step of [t, t')."""

    left: Formula
    right: Formula

    def __str__(self) -> str:
        return f"{self.left._at(UNTIL + 1)} U[{self.a},{self.b}] {self.right._at(UNTIL + 1)}"


_BINDING: dict[type[Node], int] = {
    Neg: NEGATION,
    Comparison: COMPARISON,
    Not: PREFIX,
    Always: PREFIX,
    Eventually: PREFIX,
    Until: UNTIL,
    And: AND,
    Or: OR,
    Implies: IMPLIES,
}


def _check_window(a: Any, b: Any) -> None:
    whole = all(isinstance(bound, int) and not isinstance(bound, bool) for bound in (a, b))
    if not whole or not 0 <= a <= b <= MAX_BOUND:
        expected = f"whole numbers with 0 <= a <= b <= {MAX_BOUND}"
        raise FormulaError(f"[{a},{b}] is not a window; expected {expected}", got=[a, b], expected=expected)


def _check_name(name: str) -> None:
    how, region = region_named(name)
    if not (is_name(region) and (how is None or (how in BODY_WORDS and name == body_name(how, region)))):
        expected = "letters, digits and _, not starting with a digit, and not a keyword"
        problem = f"{name!r} cannot be a name in a formula; expected {expected}"
        raise FormulaError(problem, got=name, expected=expected)
