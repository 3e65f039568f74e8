"""The fragment of STL that tables and networks can be made for.

    phi = psi | phi and phi | F[a,b] psi | G[a,b] psi | F[a,c1] G[c2,b] psi       (the paper's grammar of STL)

psi is any boolean combination of predicates, without temporal operators. Many other formulas have the same
robustness as one of this form and are rewritten: `not` moves inwards, F F and G G merge into one, G over
`and` splits, and an operator with a window of one step only shifts the windows below it.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from specshield.errors import FragmentError
from specshield.stl import Always, Eventually, Formula, conjuncts
from specshield.stl.conjunction import is_predicate, signed


class Obligation(NamedTuple):
    """One conjunct, on steps counted from 0.

    eventually:         predicate at some t in [a, b]
    always:             predicate at every t in [a, b]
    eventually_always:  F[a,c1] G[c2,b]: for some t in [a, c1], predicate at every step of [t + c2, t + b]
    """

    kind: Literal["eventually", "always", "eventually_always"]
    a: int
    b: int
    c1: int  # c1 and c2 are 0 except in an eventually_always
    c2: int
    predicate: Formula


def obligations(formula: Formula) -> tuple[Obligation, ...]:
    """The obligations whose conjunction is `formula`, in the order of the text; rho is their minimum.

    A predicate alone is an obligation for step 0. Raises FragmentError with the sub-formula that is outside
    the fragment.
    """
    return tuple(found for conjunct in conjuncts(formula) for found in _normal(conjunct))


def _normal(formula: Formula) -> tuple[Obligation, ...]:
    if is_predicate(formula):
        return (Obligation("always", 0, 0, 0, 0, signed(formula, False)),)
    parts = conjuncts(formula)
    if parts != (formula,):
        return tuple(found for part in parts for found in _normal(part))
    match formula:
        case Always(a, b, child) | Eventually(a, b, child):
            inner = _normal(child)
            merges = isinstance(formula, Always) and all(each.kind == "always" for each in inner)
            if a == b or merges:
                return tuple(_shifted(each, a, b) for each in inner)
            if isinstance(formula, Eventually) and len(inner) == 1:
                return (_under_eventually(a, b, inner[0]),)
    raise FragmentError(
        "a part of the formula is of a form that is not taken here",
        got=str(formula),
        expected="parts F[a,b] p, G[a,b] p and F[a,c] G[d,b] p, joined by 'and', with no F, G or U in p; or "
        "the method 'planner', which takes any formula",
    )


def _under_eventually(a: int, b: int, inner: Obligation) -> Obligation:
    if inner.kind != "always":
        return _shifted(inner, a, b)
    if inner.a == inner.b:
        return Obligation("eventually", a + inner.a, b + inner.a, 0, 0, inner.predicate)
    return Obligation("eventually_always", a, inner.b, b, inner.a, inner.predicate)


def _shifted(inner: Obligation, a: int, b: int) -> Obligation:
    """F[a,b] of an inner F, or G[a,b] of an inner G: one obligation over the sum of the windows."""
    if inner.kind == "eventually_always":
        return inner._replace(a=inner.a + a, c1=inner.c1 + b)
    return inner._replace(a=inner.a + a, b=inner.b + b)
