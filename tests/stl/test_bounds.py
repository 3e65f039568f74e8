"""Bounds on prefixes, and the three-valued verdict that rests on them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from specshield.errors import SampleError
from specshield.stl import SATISFIED_ABOVE, parse, robustness, robustness_bounds, verdict
from tests.stl.formulas import finite, formulas, terms, traces

INF = math.inf


@pytest.mark.parametrize(
    ("text", "prefix", "lo", "hi"),
    [
        ("F[0,3] x", [1.0, 2.0], 2.0, INF),
        ("G[0,3] x", [1.0, 2.0], -INF, 1.0),
        ("not F[0,3] x", [1.0, 2.0], -INF, -2.0),
        ("F[0,1] x", [1.0, 2.0], 2.0, 2.0),
        ("F[0,1] x", [1.0, 2.0, 9.0], 2.0, 2.0),
        ("F[2,3] x", [1.0, 2.0], -INF, INF),
        ("x", [], -INF, INF),
        ("x U[0,3] x > 5", [1.0, 2.0], -3.0, 1.0),
        ("F[0,2] x and G[0,2] x < 4", [1.0, 2.0], -INF, 2.0),
        ("F[0,2] abs(x) > 3", [1.0], -2.0, INF),
        ("G[0,2] abs(x) > 3", [1.0], -3.0, -2.0),
        ("G[0,1] 1 / (abs(x) + 2) < 1", [0.0], 0.5, 0.5),
        ("G[0,1] 1 / (abs(x) + 2) > 0", [0.0], 0.0, 0.5),
        ("G[0,1] 1 / x > 0", [0.5], -INF, 2.0),
        ("G[0,1] 1 / abs(x) > 0", [0.5], -INF, 2.0),  # the divisor's interval holds 0
        ("G[0,1] 0 * x < 1", [7.0], 1.0, 1.0),
        ("F[1,1] -abs(x) * 2 + 1 > 0", [7.0], -INF, 1.0),
        ("F[0,9] 1 > 0", [], 1.0, 1.0),
    ],
)
def test_by_hand(text: str, prefix: list[float], lo: float, hi: float) -> None:
    assert robustness_bounds(parse(text), {"x": prefix}) == (lo, hi)


ANY_TERM = terms(finite, operators="+-*/")


@settings(max_examples=250)
@given(st.data())
def test_sound_monotone_and_tight_in_the_end(data: st.DataObject) -> None:
    """Along any trajectory the bounds close in on its robustness and the verdict never takes itself back."""
    formula = data.draw(formulas(data.draw(st.sampled_from((None, ANY_TERM)))))
    samples = data.draw(traces(formula.horizon + 2))
    try:
        rho = robustness(formula, samples)
    except SampleError:  # no robustness on this continuation, so nothing to bound
        return
    previous = (-INF, INF)
    decided = "pending"
    for n in range(formula.horizon + 3):
        prefix = {name: values[:n] for name, values in samples.items()}
        lo, hi = robustness_bounds(formula, prefix)
        assert previous[0] <= lo <= rho <= hi <= previous[1]
        previous = (lo, hi)
        now = verdict(formula, prefix)
        assert decided in ("pending", now)
        decided = now
    assert previous == (rho, rho)
    assert decided == ("satisfied" if rho > SATISFIED_ABOVE else "violated")


def test_batches() -> None:
    x = np.array([[1.0, -1.0], [2.0, 3.0]])
    lo, hi = robustness_bounds(parse("G[0,2] x"), {"x": x})
    assert lo.tolist() == [-INF, -INF]
    assert hi.tolist() == [-1.0, 2.0]
    lo, hi = robustness_bounds(parse("F[3,4] x"), {"x": x})
    assert lo.shape == hi.shape == (2,)


def test_zero_is_not_satisfied() -> None:
    assert verdict(parse("x"), {"x": [0.0]}) == "violated"
    assert verdict(parse("x"), {"x": [5e-324]}) == "satisfied"
    assert verdict(parse("not x"), {"x": [0.0]}) == "violated"


def test_an_always_to_the_horizon_stays_pending_until_its_last_step() -> None:
    formula = parse("G[0,150] not Forbidden")
    kept = [-1.0] * 151
    assert verdict(formula, {"Forbidden": kept[:150]}) == "pending"
    assert verdict(formula, {"Forbidden": kept}) == "satisfied"
    assert verdict(formula, {"Forbidden": [*kept[:3], 0.0]}) == "violated"


def test_a_margin_asks_for_more() -> None:
    formula = parse("F[0,2] x")
    assert verdict(formula, {"x": [0.2]}, margin=0.3) == "pending"
    assert verdict(formula, {"x": [0.2]}) == "satisfied"
    assert verdict(formula, {"x": [0.2, 0.1, 0.3]}, margin=0.3) == "violated"


def test_what_a_prefix_cannot_be() -> None:
    with pytest.raises(SampleError, match="step 1 is nan"):
        robustness_bounds(parse("F[0,9] x"), {"x": [1.0, math.nan]})
    with pytest.raises(SampleError, match="'1 / x' is not finite at step 1"):
        robustness_bounds(parse("F[0,9] 1 / x > 2"), {"x": [1.0, 0.0]})
    with pytest.raises(SampleError, match="one trajectory"):
        verdict(parse("x"), {"x": [[1.0]]})
