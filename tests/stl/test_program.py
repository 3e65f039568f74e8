from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from specshield.errors import FormulaError, FragmentError, SampleError
from specshield.stl import Abs, Comparison, Formula, Name, Neg, Number, Term, parse, robustness
from specshield.stl.program import STACK_SIZE, compile_predicates, evaluate_packed
from tests.stl.formulas import NAMES, finite, predicates, terms

SLOTS = {name: i for i, name in enumerate(NAMES)}
STACK = np.empty(STACK_SIZE)


@settings(max_examples=300)
@given(predicates(terms(finite)), st.lists(finite, min_size=len(NAMES), max_size=len(NAMES)))
def test_equal_to_robustness_bit_for_bit(predicate: Formula, values: list[float]) -> None:
    state = np.array(values)
    ran = evaluate_packed(0, compile_predicates([predicate], SLOTS), state, STACK)
    try:
        rho = robustness(predicate, {name: state[i : i + 1] for name, i in SLOTS.items()})
    except SampleError:
        assert np.isnan(ran)
    else:
        assert np.float64(ran).tobytes() == rho.tobytes()


def test_packed_programs() -> None:
    texts = ["x", "x - y / 2 > abs(_)", "not (x and y) or GF -> notable <= 3", "1 / x > 0"]
    predicates = [parse(text) for text in texts]
    packed = compile_predicates(predicates, SLOTS)
    state = np.random.default_rng(5).normal(size=len(SLOTS))
    for k, predicate in enumerate(predicates):
        rho = robustness(predicate, {name: [state[i]] for name, i in SLOTS.items()})
        assert evaluate_packed(k, packed, state, STACK) == rho
    assert np.isnan(evaluate_packed(3, packed, np.zeros(len(SLOTS)), STACK))
    assert compile_predicates([], SLOTS).starts.tolist() == [0]


def test_the_deepest_predicate_fits_the_stack() -> None:
    text = "x > 0"
    for _ in range(30):
        text = f"y and (y or ({text}))"
    predicate = parse(text)
    assert predicate.depth == 62
    packed = compile_predicates([predicate], {"x": 0, "y": 1})
    assert evaluate_packed(0, packed, np.array([2.0, 1.0]), STACK) == 1.0


def test_refusals() -> None:
    with pytest.raises(FragmentError, match="temporal"):
        compile_predicates([parse("x and F[0,1] x")], SLOTS)
    with pytest.raises(FormulaError, match="nothing declares 'z'"):
        compile_predicates([parse("x > z")], SLOTS)
    term: Term = Name("x")
    for _ in range(STACK_SIZE):
        term = Neg(Abs(term))
    with pytest.raises(FormulaError, match="deep"):
        compile_predicates([Comparison(">", term, Number(0))], SLOTS)
