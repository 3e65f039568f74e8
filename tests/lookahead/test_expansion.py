"""D after each motion on a world of two cells, for the stand-in that wanders."""

import numpy as np
import pytest

from specshield.lookahead.belief import STYLE
from specshield.lookahead.desirability import UNKEEPABLE, solve
from specshield.lookahead.expansion import Bank, expand_all
from specshield.lookahead.goals import UNIT
from specshield.lookahead.surrogate import AHEAD, OTHER, SEARCH_PRICE, WANDER, WANDER_END, stand_in_for
from tests.lookahead.by_hand import BACK, EAST, GO, STOP, WEST, goals_of, make_world

OPEN = np.exp([AHEAD, OTHER, OTHER])  # what it says of going on, back and stopping in the western cell


def after_each(formula, pose, t=0, settled=0):
    body, rules, planes = make_world(formula)
    goals = goals_of(body, (UNIT, 0))
    table = solve(planes, stand_in_for(goals, planes, WANDER, STYLE))
    out, bank = np.empty((1, 3)), Bank(rules, goals, planes, np.array([WANDER]), table[None])
    expand_all(bank, np.array([0]), STYLE, t, settled, np.array(pose), out)
    return out[0]


def test_at_the_last_step_a_motion_settles_the_rule_or_does_not():
    d = after_each("F[0,1] B", WEST)
    assert d[GO] == pytest.approx(0.0, abs=1e-9)
    assert d[BACK] == d[STOP] == UNKEEPABLE


def test_a_step_earlier_what_is_not_settled_has_its_price():
    """After a step that goes nowhere the stand-in has to go on, or to end."""
    d = after_each("F[0,2] B", WEST)
    expected = SEARCH_PRICE - (1.0 - WANDER_END) * np.log(OPEN[GO] / OPEN.sum())
    assert d[GO] == pytest.approx(0.0, abs=1e-9)
    assert d[[BACK, STOP]] == pytest.approx(expected, rel=1e-3)


def test_what_breaks_an_always_has_no_d():
    d = after_each("F[0,3] B and G[2,3] not B", WEST)
    assert d[GO] < UNKEEPABLE  # there at step 1 and back at step 2
    assert d[BACK] == d[STOP] == UNKEEPABLE
    d = after_each("F[0,3] B and G[2,3] not B", EAST, t=1, settled=1)
    assert d[BACK] < UNKEEPABLE
    assert d[GO] == d[STOP] == UNKEEPABLE
