"""The fragment that tables can be made for: conjunctions of F, G and F[a,c1] G[c2,b] over predicates.

    phi = psi | phi and phi | F[a,b] psi | G[a,b] psi | F[a,c1] G[c2,b] psi       (the paper's grammar of STL)

psi is any boolean combination of predicates, without temporal operators. A formula that means such a
conjunction without being written as one is brought into the form: `not` moves inwards, F F and G G merge, G
over `and` splits, a window of one step is only a shift. The robustness stays the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from specshield.errors import FragmentError
from specshield.stl.formula import Always, And, Eventually, Formula, Implies, Node, Not, Or, Windowed


@dataclass(frozen=True)
class Obligation:
    """One conjunct, on steps counted from 0.

    eventually:         predicate at some t in [a, b]
    always:             predicate at every t in [a, b]
    eventually_always:  F[a,c1] G[c2,b]: for some t in [a, c1], predicate at every step of [t + c2, t + b]
    """

    kind: Literal["eventually", "always", "eventually_always"]
    a: int
    b: int
    c1: int  # c1 and c2 are 0 but for eventually_always
    c2: int
    predicate: Formula


def conjuncts(formula: Formula) -> tuple[Formula, ...]:
    """The formulas that `formula` joins by `and` at its top, left to right."""
    if isinstance(formula, And):
        return tuple(leaf for child in formula.children for leaf in conjuncts(child))
    return (formula,)


def is_predicate(node: Node) -> bool:
    """Whether it has no temporal operator."""
    return not isinstance(node, Windowed) and all(is_predicate(part) for part in node.parts)


def obligations(formula: Formula) -> tuple[Obligation, ...]:
    """The obligations whose conjunction is `formula`, in the order it is written; rho is their minimum.

    A predicate alone is due at step 0. FragmentError, naming the sub-formula, where it is outside.
    """
    return tuple(found for conjunct in conjuncts(formula) for found in _normal(conjunct, negated=False))


def _normal(formula: Formula, negated: bool) -> tuple[Obligation, ...]:
    """The obligations of `formula`, or of its negation."""
    if is_predicate(formula):
        return (Obligation("always", 0, 0, 0, 0, _predicate(formula, negated)),)
    match formula:
        case Not(child):
            return _normal(child, not negated)
        case And(children) if not negated:
            return tuple(found for child in children for found in _normal(child, negated))
        case Or(children) if negated:
            return tuple(found for child in children for found in _normal(child, negated))
        case Implies(left, right) if negated:
            return (*_normal(left, False), *_normal(right, True))
        case Always(a, b, child) | Eventually(a, b, child):
            inner = _normal(child, negated)
            if a == b:
                return tuple(_shifted(obligation, a, a) for obligation in inner)
            if isinstance(formula, Always) is not negated:
                return tuple(_under_always(formula, a, b, obligation) for obligation in inner)
            if len(inner) == 1:
                return (_under_eventually(a, b, inner[0]),)
    raise _outside(formula)


def _predicate(formula: Formula, negated: bool) -> Formula:
    if isinstance(formula, Not):
        return _predicate(formula.child, not negated)
    return Not(formula) if negated else formula


def _under_always(formula: Formula, a: int, b: int, inner: Obligation) -> Obligation:
    if inner.kind == "always":
        return _shifted(inner, a, b)
    raise _outside(formula)


def _under_eventually(a: int, b: int, inner: Obligation) -> Obligation:
    if inner.kind != "always":
        return _shifted(inner, a, b)
    if inner.a == inner.b:
        return Obligation("eventually", a + inner.a, b + inner.a, 0, 0, inner.predicate)
    return Obligation("eventually_always", a, inner.b, b, inner.a, inner.predicate)


def _shifted(inner: Obligation, a: int, b: int) -> Obligation:
    """The outer window [a, b] joined to the inner one of the same operator."""
    if inner.kind == "eventually_always":
        return replace(inner, a=inner.a + a, c1=inner.c1 + b)
    return replace(inner, a=inner.a + a, b=inner.b + b)


def _outside(formula: Formula) -> FragmentError:
    expected = "conjunctions of F, G and F[a,c1] G[c2,b] over boolean combinations of predicates"
    return FragmentError(
        f"'{formula}' is outside the fragment of this method; expected {expected}",
        got=str(formula),
        expected=f"{expected}; or method 'planner', which takes any formula",
    )
