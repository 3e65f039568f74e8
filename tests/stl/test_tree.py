"""Compiled trees give what the evaluator gives, to the last bit, whole and on prefixes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from specshield.errors import FormulaError
from specshield.stl import Formula, parse, robustness, robustness_bounds
from specshield.stl.program import STACK_SIZE, evaluate_packed
from specshield.stl.tree import compile_tree, tree_bounds, tree_value
from tests.stl.formulas import NAMES, formulas, traces

SLOTS = {name: i for i, name in enumerate(NAMES)}
LENGTH = 24


def run(
    formula: Formula, samples: dict[str, list[float]], known: int, ahead: bool = False
) -> tuple[float, float, float | None]:
    """The bounds on the first `known` samples, and the value where they are all there."""
    tree, stack = compile_tree(formula, SLOTS, ahead), np.empty(STACK_SIZE)
    low, high = np.full(tree.size, np.nan), np.full(tree.size, np.nan)
    for n in range(len(tree.leaf_at)):
        for t in range(tree.leaf_start[n], tree.leaf_stop[n]):
            i = tree.leaf_at[n] + t - tree.leaf_start[n]
            low[i], high[i] = tree.low[n], tree.high[n]
            if t < known:
                values = np.array([samples[name][t] for name in NAMES])
                low[i] = high[i] = evaluate_packed(n, tree.programs, values, stack)
    whole = tree_value(tree, low.copy()) if known > formula.horizon else None
    return *tree_bounds(tree, low, high), whole


@settings(max_examples=400)
@given(formulas(max_leaves=8), traces(LENGTH), st.integers(1, LENGTH), st.booleans())
def test_equal_to_the_evaluator_bit_for_bit(
    formula: Formula, samples: dict[str, list[float]], known: int, ahead: bool
) -> None:
    low, high, whole = run(formula, samples, known, ahead)
    prefix = {name: values[:known] for name, values in samples.items()}
    expected = robustness_bounds(formula, prefix)
    assert (np.float64(low).tobytes(), np.float64(high).tobytes()) == tuple(e.tobytes() for e in expected)
    if known > formula.horizon:
        assert np.float64(whole).tobytes() == robustness(formula, samples).tobytes()


def test_by_hand() -> None:
    # x U[1,2] y: y at 1 with x before it, or y at 2 with x at 0 and 1; G within F: the best of three windows.
    samples = {name: [0.0] * 8 for name in NAMES} | {
        "x": [3.0, 1.0, 4, 1, 5, 0, 0, 0],
        "y": [9.0, -1.0, 2, 0, 0, 0, 0, 0],
    }
    assert run(parse("x U[1,2] y"), samples, 8)[2] == 1.0
    assert run(parse("F[0,2] G[0,2] x"), samples, 8)[2] == 1.0
    assert run(parse("F[1,3] G[1,1] x"), samples, 8)[2] == 5.0
    assert run(parse("F[0,3] x"), samples, 2)[:2] == (3.0, np.inf)


def test_a_name_that_nothing_declares() -> None:
    with pytest.raises(FormulaError, match="Nowhere"):
        compile_tree(parse("F[0,1] Nowhere"), SLOTS)
