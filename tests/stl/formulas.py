"""Hypothesis strategies of formulas and samples."""

from __future__ import annotations

from functools import cache

from hypothesis import strategies as st

from specshield import stl

NAMES = ("x", "y", "Charger1", "Bedroom_2", "_", "GF", "notable")

finite = st.floats(allow_nan=False, allow_infinity=False)
TAME = (0.0, 1.0, -1.0, 0.5, -0.5, 0.25, -2.0, 3.0)
tame = st.sampled_from(TAME)


def windows(limit: int = 4) -> st.SearchStrategy[tuple[int, int]]:
    return st.sampled_from([(a, b) for a in range(limit + 1) for b in range(a, limit + 1)])


def terms(numbers: st.SearchStrategy[float] = tame, operators: str = "+-*/") -> st.SearchStrategy[stl.Term]:
    leaves = st.sampled_from(NAMES).map(stl.Name) | numbers.map(stl.Number)
    return st.recursive(
        leaves,
        lambda term: (
            term.map(stl.Neg)
            | term.map(stl.Abs)
            | st.builds(stl.Arithmetic, st.sampled_from(operators), term, term)
        ),
        max_leaves=4,
    )


def predicates(term: st.SearchStrategy[stl.Term] | None = None) -> st.SearchStrategy[stl.Formula]:
    term = terms(operators="+-*") if term is None else term
    leaves = st.sampled_from(NAMES).map(stl.Atom) | st.builds(
        stl.Comparison, st.sampled_from(("<", "<=", ">", ">=")), term, term
    )
    return st.recursive(leaves, booleans, max_leaves=4)


def booleans(child: st.SearchStrategy[stl.Formula]) -> st.SearchStrategy[stl.Formula]:
    several = st.lists(child, min_size=2, max_size=3).map(tuple)
    return (
        child.map(stl.Not) | several.map(stl.And) | several.map(stl.Or) | st.builds(stl.Implies, child, child)
    )


@cache  # a strategy that is built anew for each example is looked through anew: most of a test's time
def formulas(
    term: st.SearchStrategy[stl.Term] | None = None, max_leaves: int = 5
) -> st.SearchStrategy[stl.Formula]:
    """Any formula, of a horizon small enough for the brute-force oracle."""
    return st.recursive(
        predicates(term),
        lambda child: (
            booleans(child)
            | st.builds(lambda w, f: stl.Always(*w, f), windows(), child)
            | st.builds(lambda w, f: stl.Eventually(*w, f), windows(), child)
            | st.builds(lambda w, f, g: stl.Until(*w, f, g), windows(), child, child)
        ),
        max_leaves=max_leaves,
    )


def traces(length: int) -> st.SearchStrategy[dict[str, list[float]]]:
    """One trajectory's samples of each name in NAMES: drawn as a byte each, since floats are slow to draw."""
    size = length * len(NAMES)
    return st.binary(min_size=size, max_size=size).map(
        lambda drawn: {
            name: [TAME[byte % len(TAME)] for byte in drawn[i :: len(NAMES)]] for i, name in enumerate(NAMES)
        }
    )
