"""The nodes of an STL formula: frozen, hashable, and printed so that `parse(str(f)) == f`.

Terms are real-valued at each time step, formulas have a robustness at each time step. Windows are closed and
in whole steps; for `F`, `G` and `U` they are relative to the step at which the operator is evaluated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import chain
from typing import Literal

from specshield.errors import FormulaError

KEYWORDS = frozenset({"F", "G", "U", "not", "always", "eventually", "until", "and", "or", "implies", "abs"})
BODY_WORDS = ("touches", "inside")  # touches(R): some part of the footprint is in R; inside(R): all of it is
MAX_BOUND = 100_000  # steps; bounds the memory that a formula's samples take where no horizon limit is set

# How tightly each kind of expression binds. An operand that binds less tightly than its place asks is printed
# in parentheses.
IMPLIES, OR, AND, UNTIL, PREFIX, COMPARISON, SUM, PRODUCT, NEGATION, PRIMARY = range(1, 11)


def is_name(text: str) -> bool:
    """Whether `text` can be a name in a formula: letters a to z, digits and _, no digit first, no keyword."""
    return text.isascii() and text.isidentifier() and text not in KEYWORDS


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

    def __str__(self) -> str:
        return self._written[1]

    def _at(self, binding: int) -> str:
        own, text = self._written
        return text if own >= binding else f"({text})"

    @property
    def _written(self) -> tuple[int, str]:
        """How tightly the node binds, and its text."""
        match self:
            case Number(value):
                return PRIMARY, repr(value).removesuffix(".0")
            case Name(name) | Atom(name):
                return PRIMARY, name
            case Neg(Number() as child) if not str(child).startswith("-"):
                return NEGATION, f"-({child})"  # `-3` parses as the number minus three
            case Neg(child):
                return NEGATION, f"-{child._at(NEGATION)}"
            case Abs(child):
                return PRIMARY, f"abs({child})"
            case Arithmetic(op, left, right):
                own = SUM if op in "+-" else PRODUCT
                return own, f"{left._at(own)} {op} {right._at(own + 1)}"
            case Comparison(op, left, right):
                return COMPARISON, f"{left._at(SUM)} {op} {right._at(SUM)}"
            case Not(child):
                return PREFIX, f"not {child._at(PREFIX)}"
            case And(children):
                return AND, " and ".join(child._at(AND + 1) for child in children)
            case Or(children):
                return OR, " or ".join(child._at(OR + 1) for child in children)
            case Implies(left, right):
                return IMPLIES, f"{left._at(IMPLIES + 1)} -> {right._at(IMPLIES + 1)}"
            case Always(a, b, child):
                return PREFIX, f"G[{a},{b}] {child._at(PREFIX)}"
            case Eventually(a, b, child):
                return PREFIX, f"F[{a},{b}] {child._at(PREFIX)}"
            case Until(a, b, left, right):
                return UNTIL, f"{left._at(UNTIL + 1)} U[{a},{b}] {right._at(UNTIL + 1)}"
        raise TypeError(f"not a formula: {self!r}")


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


@dataclass(frozen=True)
class Name(Term):
    """The sampled value of a name: a region's signed distance, `touches` or `inside` of a region, a
    coordinate, a signal."""

    name: str

    def __post_init__(self) -> None:
        _check_name(self.name)


@dataclass(frozen=True)
class Neg(Term):
    child: Term


@dataclass(frozen=True)
class Abs(Term):
    child: Term


@dataclass(frozen=True)
class Arithmetic(Term):
    op: Literal["+", "-", "*", "/"]
    left: Term
    right: Term


@dataclass(frozen=True)
class Formula(Node):
    """Base of the nodes that have a robustness rho at each step. A formula is satisfied where rho > 0."""

    @cached_property
    def horizon(self) -> int:
        """hrz: the last step whose samples the formula may need, counted from the step of evaluation."""
        below = (part.horizon for part in self.parts if isinstance(part, Formula))
        return (self.b if isinstance(self, Windowed) else 0) + max(below, default=0)


@dataclass(frozen=True)
class Atom(Formula):
    """A name used as a truth value: rho is its sample, for a region the signed distance, positive inside."""

    name: str

    def __post_init__(self) -> None:
        _check_name(self.name)


@dataclass(frozen=True)
class Comparison(Formula):
    """rho is left - right for `>` and `>=`, right - left for `<` and `<=`."""

    op: Literal["<", "<=", ">", ">="]
    left: Term
    right: Term


@dataclass(frozen=True)
class Not(Formula):
    child: Formula


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
    """rho is the least of the children's."""


@dataclass(frozen=True)
class Or(Joined):
    """rho is the largest of the children's."""


@dataclass(frozen=True)
class Implies(Formula):
    left: Formula
    right: Formula


@dataclass(frozen=True)
class Windowed(Formula):
    """Base of the temporal operators: their window is [a, b], 0 <= a <= b."""

    a: int
    b: int

    def __post_init__(self) -> None:
        window = (self.a, self.b)
        whole = all(isinstance(bound, int) and not isinstance(bound, bool) for bound in window)
        if not whole or not 0 <= self.a <= self.b <= MAX_BOUND:
            problem = f"[{self.a},{self.b}] is not a window"
            expected = f"whole numbers with 0 <= a <= b <= {MAX_BOUND}"
            raise FormulaError(f"{problem}; expected {expected}", got=[*window], expected=expected)


@dataclass(frozen=True)
class Always(Windowed):
    child: Formula


@dataclass(frozen=True)
class Eventually(Windowed):
    child: Formula


@dataclass(frozen=True)
class Until(Windowed):
    """left U[a,b] right: right at some t' in [t+a, t+b], and left at every step of [t, t')."""

    left: Formula
    right: Formula


def _check_name(name: str) -> None:
    how, region = region_named(name)
    if not (is_name(region) and (how is None or (how in BODY_WORDS and name == body_name(how, region)))):
        expected = "letters, digits and _, the first no digit, and no keyword"
        problem = f"{name!r} cannot be a name in a formula; expected {expected}"
        raise FormulaError(problem, got=name, expected=expected)
