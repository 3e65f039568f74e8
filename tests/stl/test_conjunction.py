from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from specshield.stl import conjuncts, parse, robustness
from tests.stl.formulas import formulas, traces


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "a and (F[0,1] b and (c or a)) and G[0,1] (a and b)",
            ["a", "F[0,1] b", "c or a", "G[0,1] (a and b)"],
        ),
        ("not F[1,4] a", ["G[1,4] not a"]),
        ("not G[1,4] not a", ["F[1,4] a"]),
        ("not not F[1,4] a", ["F[1,4] a"]),
        ("not F[1,4] G[0,2] a", ["G[1,4] not G[0,2] a"]),
        ("not (F[0,1] a or not (b and c))", ["G[0,1] not a", "b", "c"]),
        ("not (F[0,1] a -> G[0,2] b)", ["F[0,1] a", "F[0,2] not b"]),
        ("not (a and b)", ["not (a and b)"]),
        ("not (a U[0,3] b)", ["not (a U[0,3] b)"]),
    ],
)
def test_conjuncts(text: str, expected: list[str]) -> None:
    assert [str(part) for part in conjuncts(parse(text))] == expected


@settings(max_examples=200)
@given(st.data())
def test_the_conjuncts_together_have_the_formulas_robustness(data: st.DataObject) -> None:
    formula = data.draw(formulas())
    parts = conjuncts(formula)
    samples = data.draw(traces(formula.horizon + 1))
    assert max(part.horizon for part in parts) == formula.horizon
    assert min(robustness(part, samples) for part in parts) == robustness(formula, samples)
