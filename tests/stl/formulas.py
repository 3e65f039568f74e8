"""Hypothesis strategies of formulas and samples."""

from __future__ import annotations

from hypothesis import strategies as st

from specshield import stl

NAMES = ("x", "y", "Charger1", "Bedroom_2", "_", "GF", "notable")

finite = st.floats(allow_nan=False, allow_infinity=False)
tame = st.sampled_from([-2.0, -1.0, -0.5, 0.0, 0.25, 0.5, 1.0, 3.0])


@st.composite
def windows(draw: st.DrawFn, limit: int = 4) -> tuple[int, int]:
    a, b = sorted((draw(st.integers(0, limit)), draw(st.integers(0, limit))))
    return a, b


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
    """One trajectory's samples of each name in NAMES."""
    return st.fixed_dictionaries({name: st.lists(tame, min_size=length, max_size=length) for name in NAMES})
