from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from specshield.errors import SampleError
from specshield.stl import parse, robustness
from tests.oracles.brute_stl import brute_robustness
from tests.stl.formulas import formulas, traces

A = [1.0, -2.0, 3.0, 0.5, -1.0]
B = [-3.0, -1.0, 2.0, 4.0, 0.25]


@pytest.mark.parametrize(
    ("text", "rho"),
    [
        ("a", 1.0),
        ("a > 3", -2.0),
        ("a >= 3", -2.0),
        ("a < 3", 2.0),
        ("a <= 3", 2.0),
        ("not a", -1.0),
        ("a and b", -3.0),
        ("a or b", 1.0),
        ("a -> b", -1.0),
        ("b -> a", 3.0),
        ("G[0,4] a", -2.0),
        ("G[2,3] a", 0.5),
        ("F[0,4] b", 4.0),
        ("F[1,1] a", -2.0),
        ("F[0,2] G[1,2] b", 2.0),  # the best of min(-1, 2), min(2, 4), min(4, 0.25)
        ("G[0,2] F[0,1] a", 1.0),  # the worst of max(1, -2), max(-2, 3), max(3, 0.5)
        ("a U[0,2] b", -1.0),  # the best of -3, min(-1, 1), min(2, 1, -2)
        ("a U[0,0] b", -3.0),  # the left side is needed on [t, t'), here nowhere
        ("a U[1,1] b", -1.0),  # min(b(1), a(0)); a(1) = -2 is not asked for
        ("abs(a - b) * 2 > 1", 7.0),
        ("-a / 4 + b < 0", 3.25),
        ("1 < 2", 1.0),
    ],
)
def test_by_hand(text: str, rho: float) -> None:
    assert robustness(parse(text), {"a": A, "b": B}) == rho


@settings(max_examples=300)
@given(st.data())
def test_agrees_with_the_definition(data: st.DataObject) -> None:
    formula = data.draw(formulas())
    samples = data.draw(traces(formula.horizon + data.draw(st.integers(1, 3))))
    assert robustness(formula, samples) == brute_robustness(formula, samples)


@pytest.mark.parametrize("window", [(0, 1), (0, 6), (0, 7), (0, 8), (3, 3), (2, 21), (5, 18), (0, 31)])
def test_nested_windows_of_every_width(window: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    a, b = window
    for text in (f"G[0,9] F[{a},{b}] x", f"F[0,9] G[{a},{b}] x", f"G[0,9] (x U[{a},{b}] y)"):
        formula = parse(text)
        samples = {name: rng.normal(size=(4, 50)) + 0.5 for name in "xy"}
        expected = [brute_robustness(formula, {n: list(v[i]) for n, v in samples.items()}) for i in range(4)]
        assert robustness(formula, samples).tolist() == expected


def test_batches_broadcast() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(3, 2, 8)), rng.normal(size=8)
    formula = parse("F[0,7] (x and y) and not G[0,5] y > x")
    rho = robustness(formula, {"x": x, "y": y, "unused": rng.normal(size=4)})
    assert rho.shape == (3, 2)
    assert rho.dtype == np.float64
    assert rho[2, 1] == robustness(formula, {"x": x[2, 1], "y": y})
    assert robustness(parse("1 > 0"), {"x": x}).shape == (3, 2)
    assert robustness(parse("F[0,3] 2 > x - x"), {"x": x}).tolist() == [[2.0, 2.0]] * 3


def test_only_the_steps_a_window_covers_are_computed() -> None:
    ratio = [0.0, 2.0, 0.0]
    assert robustness(parse("G[1,1] 1 / x > 0"), {"x": ratio}) == 0.5


def test_samples_are_left_alone_and_not_shared() -> None:
    x = np.array([1.0, -0.0])
    rho = robustness(parse("x"), {"x": x})
    rho += 1
    assert x[0] == 1.0
    assert not np.signbit(robustness(parse("F[1,1] x"), {"x": x}))  # one zero only


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        ({"x": [1.0, 2.0]}, "no samples of y"),
        ({"x": [1.0, 2.0], "y": [1.0, 2.0]}, "2 samples are too few for a horizon of 2"),
        ({"x": [1.0, 2.0, 3.0], "y": [1.0, np.nan, 3.0]}, "y at step 1 is nan"),
        ({"x": [[1.0, 2.0, np.inf]], "y": [1.0, 2.0, 3.0]}, "x at step 2 is inf"),
        ({"x": [1.0, 2.0, 3.0], "y": [1.0, 2.0, 3.0, 4.0]}, "different lengths"),
        ({"x": np.ones((2, 3)), "y": np.ones((5, 3))}, "batch shapes"),
        ({"x": 1.0, "y": [1.0, 2.0, 3.0]}, "not an array of numbers"),
        ({"x": ["1", "2", "3"], "y": [1.0, 2.0, 3.0]}, "not an array of numbers"),
        ({"x": [1.0, 0.0, 1.0], "y": [1.0, 0.0, 1.0]}, "'x / y' is not finite at step 1"),
        ({"x": [1.0, 1.0, 1e300], "y": [1.0, 1.0, 1e-300]}, "'x / y' is not finite at step 2"),
    ],
)
def test_samples_it_cannot_use(samples: dict[str, object], message: str) -> None:
    with pytest.raises(SampleError, match=message):
        robustness(parse("G[0,2] x / y > 0"), samples)  # type: ignore[arg-type]


def test_division_by_zero_is_found_before_it_cancels() -> None:
    with pytest.raises(SampleError) as caught:
        robustness(parse("G[0,2] 1 / (1 / x) > -1"), {"x": [1.0, 0.0, 1.0]})
    assert (caught.value.details["time"], caught.value.details["expression"]) == (1, "1 / x")


def test_the_papers_formulas_take_well_under_a_millisecond() -> None:
    formula = parse("F[0,50] R1 and F[50,100] R2 and F[100,150] R3 and G[0,150] not Forbidden")
    samples = {name: np.random.default_rng(1).normal(size=(7, 151)) for name in formula.names}
    times = []
    for _ in range(20):
        start = time.process_time()  # what others do on the machine does not count
        robustness(formula, samples)
        times.append(time.process_time() - start)
    assert min(times) < 1e-3
