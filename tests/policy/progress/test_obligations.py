from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from specshield.errors import FragmentError
from specshield.policy.progress.obligations import Obligation, obligations
from specshield.stl import Always, Eventually, Formula, parse, robustness
from tests.stl.formulas import formulas, traces


def show(obligation: Obligation) -> str:
    o = obligation
    if o.kind == "eventually_always":
        return f"F[{o.a},{o.c1}] G[{o.c2},{o.b}] {o.predicate}"
    return f"{'G' if o.kind == 'always' else 'F'}[{o.a},{o.b}] {o.predicate}"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a", ["G[0,0] a"]),
        ("F[0,60] (a or b) and F[80,140] (a or b)", ["F[0,60] a or b", "F[80,140] a or b"]),
        ("F[0,5] a and (F[5,9] b and G[0,9] not c)", ["F[0,5] a", "F[5,9] b", "G[0,9] not c"]),
        ("F[1,4] G[2,7] a", ["F[1,4] G[2,7] a"]),
        ("F[1,2] F[3,4] a", ["F[4,6] a"]),
        ("G[1,2] G[3,4] a", ["G[4,6] a"]),
        ("F[1,2] F[3,4] G[5,6] a", ["F[4,6] G[5,6] a"]),
        ("F[1,2] G[3,4] G[5,6] a", ["F[1,2] G[8,10] a"]),
        ("not F[0,3] a", ["G[0,3] not a"]),
        ("not G[0,3] not a", ["F[0,3] a"]),
        ("not (G[0,3] a or F[1,2] b)", ["F[0,3] not a", "G[1,2] not b"]),
        ("not (G[0,3] a -> b)", ["G[0,3] a", "G[0,0] not b"]),
        ("not F[0,3] G[1,2] a and b", None),  # G F
        ("not G[0,3] F[1,2] a", ["F[0,3] G[1,2] not a"]),
        ("G[0,3] (a and (b -> x > 1))", ["G[0,3] a and (b -> x > 1)"]),
        ("G[0,3] (a and G[1,2] b)", ["G[0,3] a", "G[1,5] b"]),
        ("G[2,2] (a and F[1,3] b)", ["G[2,2] a", "F[3,5] b"]),
        ("F[2,2] G[1,3] b", ["G[3,5] b"]),
        ("F[1,3] G[2,2] b", ["F[3,5] b"]),
        ("G[0,3] F[1,2] a", None),
        ("G[0,1] F[0,1] G[0,1] a", None),
        ("F[0,3] a or F[0,3] b", None),
        ("F[0,3] (a and G[0,2] b)", None),
        ("F[0,3] (a and F[0,2] b)", None),
        ("a -> F[0,3] b", None),
        ("a U[0,3] b", None),
    ],
)
def test_cases(text: str, expected: list[str] | None) -> None:
    if expected is None:
        with pytest.raises(FragmentError):
            obligations(parse(text))
    else:
        assert [show(obligation) for obligation in obligations(parse(text))] == expected


def test_the_fields() -> None:
    assert obligations(parse("F[1,4] G[2,7] a and F[5,6] b")) == (
        Obligation("eventually_always", a=1, b=7, c1=4, c2=2, predicate=parse("a")),
        Obligation("eventually", a=5, b=6, c1=0, c2=0, predicate=parse("b")),
    )


def test_the_error_names_the_part_that_is_outside() -> None:
    with pytest.raises(FragmentError, match=r"'a U\[0,3\] b'; expected parts F\[a,b\] p") as caught:
        obligations(parse("F[0,1] a and G[0,1] (b and (a U[0,3] b))"))
    assert caught.value.got == "a U[0,3] b"


def _formula(o: Obligation) -> Formula:
    if o.kind == "eventually_always":
        return Eventually(o.a, o.c1, Always(o.c2, o.b, o.predicate))
    return (Always if o.kind == "always" else Eventually)(o.a, o.b, o.predicate)


@settings(max_examples=300)
@given(st.data())
def test_the_obligations_together_have_the_formulas_robustness(data: st.DataObject) -> None:
    formula = data.draw(formulas())
    try:
        parts = [_formula(obligation) for obligation in obligations(formula)]
    except FragmentError:
        return
    samples = data.draw(traces(formula.horizon + 1))
    assert max(part.horizon for part in parts) == formula.horizon
    assert min(robustness(part, samples) for part in parts) == robustness(formula, samples)
