"""D on a world of two cells: the negative logarithm of the probability that the stand-in keeps the rule."""

import numpy as np
import pytest

from specshield.lookahead.desirability import UNKEEPABLE, desirability, solve
from specshield.lookahead.surrogate import StandIn
from tests.lookahead.by_hand import BACK, EAST, GO, STOP, WEST, make_world

R = np.array([0.2, 0.3, 0.5])  # of going on, back and stopping
CLOSE = {"rel": 0.02, "abs": 0.02}  # the codes of a table are 1/32 nat, its exp within 2 %


def solved(formula, ends=0.0, price=0.0, left=0.0):
    """D(t, pose, settled) of a stand-in that says R everywhere."""
    _, _, planes = make_world(formula)
    motions = np.empty((3, *planes.valid.shape), np.float32)
    motions[:] = np.log(R)[:, None, None]
    everywhere = np.full(planes.valid.shape, ends, np.float32)
    stand_in = StandIn(motions, everywhere, price, np.full(planes.valid.shape[1], left, np.float32))
    table = solve(planes, stand_in)
    return lambda t, pose, settled: desirability(planes, table, t, settled, *pose)


def test_one_step_before_the_end_only_one_motion_will_do():
    d = solved("F[0,1] B")
    assert d(0, WEST, 0) == pytest.approx(-np.log(R[GO]), **CLOSE)
    assert d(0, EAST, 0) == pytest.approx(-np.log(R[GO] + R[STOP]), **CLOSE)  # it is stopped there, or stays
    assert d(0, EAST, 1) == pytest.approx(0.0, abs=0.02)
    assert d(1, WEST, 0) == UNKEEPABLE


def test_two_steps_before_the_end_the_ways_are_summed():
    d = solved("F[0,2] B")
    expected = R[GO] + (R[BACK] + R[STOP]) * R[GO]  # at once, or not at once and then
    assert d(0, WEST, 0) == pytest.approx(-np.log(expected), **CLOSE)


def test_an_always_rules_out_what_would_break_it():
    d = solved("G[0,2] not B")
    assert d(0, WEST, 0) == pytest.approx(-2.0 * np.log(R[BACK] + R[STOP]), **CLOSE)
    assert d(2, WEST, 0) == 0.0


def test_after_an_end_the_rule_costs_nothing():
    d = solved("F[0,1] B", ends=0.4)
    assert d(0, WEST, 0) == pytest.approx(-0.6 * np.log(R[GO]), **CLOSE)


def test_steps_have_a_price_while_the_rule_is_pending_and_then_the_way_that_is_left():
    d = solved("F[0,1] B", price=0.5, left=1.5)
    assert d(0, WEST, 0) == pytest.approx(0.5 - np.log(R[GO]) + 1.5, **CLOSE)
    assert d(0, EAST, 1) == pytest.approx(0.0, abs=0.02)
