"""Progress against the definition: settled where every continuation satisfies, broken where none does."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from specshield.errors import FragmentError
from specshield.policy.progress import BROKEN, PENDING, SETTLED, Past, make_rules, pasts, recall, replay
from specshield.robot import STRETCH
from specshield.rule.values import signal_rows
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.brute_stl import brute_robustness

GRID = OccupancyGrid(np.zeros((20, 20), bool), 0.1)


def windows(most):
    return [(a, b) for a in range(most + 1) for b in range(a, most + 1)]


FORMULAS = [
    *(f"{op}[{a},{b}] x" for op in "FG" for a, b in windows(5) if b),
    *(f"F[{a},{c1}] G[{c2},{b}] x" for a, c1 in windows(2) for c2, b in windows(3) if c1 + b),
    "F[2,5] G[1,4] x",
    "F[0,6] G[0,3] x",
    "F[3,4] G[2,5] x",
    "not G[1,8] not x",
    "not F[2,9] x",
    "G[1,2] G[2,3] x",
    "F[1,2] F[0,3] x",
    "F[0,3] G[1,1] x",
]


def rules_of(formula, **more):
    return make_rules(make_task(GRID, STRETCH, formula.replace("x", "x > 0"), **more))


def status_of(rules, xs, signals=()):
    poses = np.zeros((len(xs), 3))
    poses[:, 0] = xs
    rows = np.reshape(signals, (len(xs), -1)).astype(float)
    return replay(rules, rules.margin, poses, rows)[0]


def recalled(rules, past, xs):
    now = recall(rules, Past(past, *trace(xs)))
    return now.status.tolist(), now.run.tolist()


def trace(xs):
    return np.array([[x, 0.0, 0.0] for x in xs]), np.empty((len(xs), 0))


@pytest.mark.parametrize("formula", FORMULAS)
def test_the_status_of_every_prefix_is_what_all_its_continuations_say(formula):
    rules = rules_of(formula)
    n = int(rules.last[0]) + 1
    kept = {
        trace: brute_robustness(formula.replace("x", "x > 0"), {"x": trace}) > 0
        for trace in itertools.product((-1.0, 1.0), repeat=n)
    }
    for length in range(1, n + 1):
        for prefix in itertools.product((-1.0, 1.0), repeat=length):
            outcomes = {kept[prefix + rest] for rest in itertools.product((-1.0, 1.0), repeat=n - length)}
            expected = PENDING if len(outcomes) == 2 else SETTLED if outcomes == {True} else BROKEN
            assert status_of(rules, prefix) == [expected], prefix


def test_zero_robustness_does_not_settle():
    assert status_of(rules_of("F[0,1] x"), [0.0]) == [PENDING]
    assert status_of(rules_of("G[0,1] x"), [0.0]) == [BROKEN]


def test_a_margin_asks_for_more():
    rules = rules_of("F[0,3] x and G[0,3] x")._replace(margin=0.5)
    assert status_of(rules, [0.5]).tolist() == [PENDING, BROKEN]
    assert status_of(rules, [0.6]).tolist() == [SETTLED, PENDING]


@pytest.mark.parametrize(
    ("formula", "xs", "by_margin", "by_zero", "margins"),
    [
        ("F[0,3] x", [0.2], [PENDING], [SETTLED], (0.5, 0.0)),  # by less: J may ask for more yet
        ("F[0,1] x", [0.2, 0.2], [BROKEN], [SETTLED], (0.5,)),  # or not any more
        ("G[0,3] x", [0.2], [BROKEN], [PENDING], (0.5,)),
        ("G[0,1] x", [0.2, 0.6], [BROKEN], [SETTLED], (0.5,)),
        ("G[0,3] x and F[0,3] x", [0.2], [BROKEN, PENDING], [PENDING, SETTLED], (0.5, 0.0)),  # of the visit
        ("G[0,3] x and F[0,3] x", [-0.1, 0.6], [BROKEN, SETTLED], [BROKEN, SETTLED], (0.5,)),
        ("F[0,3] x and F[0,3] not x", [0.6, 0.0], [SETTLED, PENDING], [SETTLED, PENDING], (0.5,)),
    ],
)
def test_what_was_kept_by_less_than_the_margin(formula, xs, by_margin, by_zero, margins):
    rules = rules_of(formula)._replace(margin=0.5)
    assert status_of(rules, xs).tolist() == by_margin
    lost = [had if asked == BROKEN else asked for asked, had in zip(by_margin, by_zero, strict=True)]
    assert recalled(rules, 0.5, xs)[0] == lost  # what can have the margin no more counts by what it has
    assert recalled(rules, 0.0, xs)[0] == by_zero
    assert [past.margin for past in pasts(rules, *trace(xs))] == list(margins)
    assert [past.margin for past in pasts(rules._replace(margin=0.0), *trace(xs))] == [0.0]


@pytest.mark.parametrize(
    ("xs", "status", "run"),
    [
        ([0.6, 0.2, 0.6], PENDING, 1),  # J asks the margin of a whole dwell
        ([0.2, 0.6, 0.6], PENDING, 2),
        ([0.2, 0.2], PENDING, 0),
        ([0.2, 0.2, 0.2], PENDING, 3),  # too late for another: the rule itself
        ([0.2, 0.2, 0.2, 0.2, 0.2], SETTLED, 5),
    ],
)
def test_a_dwell_in_progress_counts_what_keeps_the_margin(xs, status, run):
    rules = rules_of("F[0,2] G[0,4] x")._replace(margin=0.5)
    assert recalled(rules, 0.0, xs) == ([status], [run])


def test_each_conjunct_has_its_own_progress():
    rules = rules_of("F[0,1] x and F[1,3] not x and G[0,2] x")
    assert status_of(rules, [1.0, -1.0, 1.0]).tolist() == [SETTLED, SETTLED, BROKEN]


def test_the_past_of_a_signal_is_read_as_it_was():
    task = make_task(GRID, STRETCH, "F[0,5] battery > 0.5 and G[0,5] x > -9", signals={"battery": 0.1})
    rules = make_rules(task)
    rows = signal_rows(task, {"battery": np.array([0.2, 0.9, 0.3])}, 3)
    assert status_of(rules, [0.0] * 3, rows).tolist() == [SETTLED, PENDING]
    assert rules.signals.tolist() == [0.3]  # held from here on


@pytest.mark.parametrize(
    "formula", ["x > 0 U[0,3] y > 0", "F[0,3] x > 0 or G[0,3] x > 0", "G[0,2] F[0,2] x > 0"]
)
def test_outside_the_fragment_is_refused(formula):
    with pytest.raises(FragmentError):
        make_rules(make_task(GRID, STRETCH, formula))
