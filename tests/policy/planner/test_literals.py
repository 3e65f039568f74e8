"""Which literals a formula has, which of them guard, and what ends that."""

import numpy as np
import pytest

from specshield.policy.planner.literals import GUARDS, LAST, PREDICATE, SIDE, literals_of, released, separate
from specshield.stl import parse, robustness
from tests.policy.planner.worlds import cells_of


def told(formula, **signals):
    """{"not A": (guards, what ends that), ...} and the packed literals."""
    packed, literals = literals_of(*_asked(formula, signals))
    name = {1: "", -1: "not "}
    found = {
        f"{name[each.side]}{each.predicate}": (
            each.guards,
            {f"{name[side]}{predicate}" for predicate, side in each.ends},
        )
        for each in literals
    }
    return found, packed


def _asked(formula, signals):
    task = cells_of(formula, signals).task
    return task, task.formula


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("F[0,5] A", {"A": (False, set())}),
        ("G[0,5] not A", {"not A": (True, set())}),
        ("not F[0,5] A", {"not A": (True, set())}),
        ("G[2,2] A", {"A": (False, set())}),
        ("F[0,5] G[0,2] A and F[0,3] A", {"A": (True, set())}),
        ("not B U[0,6] A", {"not B": (True, {"A"}), "A": (False, set())}),
        ("not B U[0,6] A and G[0,3] not B", {"not B": (True, set()), "A": (False, set())}),
        ("G[0,4] (A -> F[0,3] B)", {"not A": (True, set()), "B": (False, set())}),
    ],
)
def test_the_literals_of_a_formula(formula, expected):
    assert told(formula)[0] == expected


def test_the_arrays_say_where_each_literal_is_read():
    _, packed = told("F[0,5] A and G[2,4] not A and F[1,3] B")
    assert packed.leaf.tolist() == [[0, 1], [0, -1], [1, 1]]  # not A is a leaf, the negation of predicate 0
    assert packed.predicate.tolist() == [[0, 1], [2, 1]]
    assert packed.literal[:, [PREDICATE, SIDE, LAST, GUARDS]].tolist() == [
        [0, 1, 5, 0], [0, -1, 4, 1], [1, 1, 3, 0],
    ]  # fmt: skip


def test_what_reads_signals_alone_is_a_leaf_but_no_literal():
    formula = "G[0,3] (event < 0.5 or A)"
    found, packed = told(formula, event=0.0)
    assert found == {"A": (True, set())}
    assert packed.leaf[:, 0].tolist() == [-1, 0]
    task, parsed = _asked(formula, {"event": 0.0})
    assert str(separate(task, parsed)) == "G[0,3] (G[0,0] event < 0.5 or A)"


def test_a_formula_without_signals_is_left_as_it_is():
    task, parsed = _asked("G[0,4] (A -> F[0,3] B) and not B U[0,6] A", {})
    assert separate(task, parsed) == parsed
    assert np.all(told(str(parsed))[1].leaf[:, 0] >= 0)


@pytest.mark.parametrize("a", [0, 1, 7])
def test_a_negated_until_that_looks_far_ahead_says_what_it_asks_for(a):
    formula = parse(f"not (not A U[{a},20] B) and F[0,20] C")
    said, random = released(formula), np.random.default_rng(0)
    samples = {name: random.normal(-0.5, 1.0, (500, 21)) for name in "ABC"}
    assert "not (not A U" not in str(said)
    np.testing.assert_array_equal(robustness(said, samples), robustness(formula, samples))


def test_any_other_rule_is_said_as_it_is():
    for text in ("not F[0,20] A and not B U[0,20] A", "not (not A U[0,16] B)", "not (F[0,3] A U[0,20] B)"):
        assert released(parse(text)) == parse(text)
