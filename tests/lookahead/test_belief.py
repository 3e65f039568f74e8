"""The belief after one observation, worked out by hand."""

import numpy as np
import pytest

from specshield.lookahead import belief as beliefs
from specshield.lookahead.belief import DOUBT, FLOOR, HABITS, KEEP, POSSIBLE, SHARP, STYLE, WARY, Belief
from specshield.lookahead.goals import UNIT
from specshield.lookahead.surrogate import AHEAD, OTHER, TURN, WANDER_END
from specshield.robot.dynamics import make_body
from specshield.world.occupancy import OccupancyGrid
from tests.lookahead.by_hand import goals_of
from tests.oracles.cells import MOTIONS, ROBOT

SAID = np.array([0.7, 0.1, 0.1, 0.1])  # ahead, left, right, wait


def softmax(logits):
    weights = np.exp(logits)
    return weights / weights.sum()


def charge(stand_in, chance, end):
    """The KL of SAID from a stand-in's motions, and the log loss of its chance to end."""
    floored = (1.0 - FLOOR) * stand_in + FLOOR / MOTIONS
    chance = 0.98 * chance + 0.005
    lost = -(end * np.log(chance) + (1.0 - end) * np.log(1.0 - chance))
    return float(SAID @ np.log(SAID / floored)) + lost


@pytest.fixture(scope="module")
def observed():
    """After SAID at a pose that faces the first of two goals and has the other behind it."""
    body = make_body(ROBOT, OccupancyGrid(np.zeros((5, 5), bool), 0.2))
    goals = goals_of(body, (UNIT, 0), (-UNIT, 0))
    begun = beliefs.begin(2, MOTIONS)
    pose = np.array([0.5, 0.5, 0.0])
    return begun, beliefs.update(begun, goals, pose, SAID, 0.1, 0.25)


def test_before_anything_is_seen(observed):
    begun, _ = observed
    np.testing.assert_allclose(begun.style, STYLE)
    assert begun.excess == WARY
    assert begun.forced == 0.0
    assert begun.trust == pytest.approx(1.0 / (1.0 + np.exp(WARY - DOUBT)))
    np.testing.assert_allclose(begun.probabilities(), [0.25, 0.25, 0.5])


def test_each_goal_and_wandering_are_charged(observed):
    _, after = observed
    expected = [
        charge(softmax([2.0, -2.0, -2.0, -1.0]), 0.0, 0.1),  # the way is ahead
        charge(softmax([-2.0, 2.0, 2.0, -1.0]), 0.0, 0.1),  # it is behind: either turn leads there
        charge(softmax([AHEAD, TURN, TURN, OTHER]), WANDER_END, 0.1),
    ]
    np.testing.assert_allclose(after.cost, expected, atol=1e-6)


def test_the_goal_that_is_charged_least_is_the_likeliest(observed):
    _, after = observed
    *goals, wander = after.probabilities()
    near, far, _ = after.cost
    assert np.exp(SHARP * (near - far)) < POSSIBLE  # so the second is left out
    assert goals[1] == 0.0
    assert wander == pytest.approx(1.0 / (1.0 + np.exp(after.cost[2] - near)))
    assert goals[0] + wander == pytest.approx(1.0)


def test_the_habit_moves_towards_what_was_said(observed):
    _, after = observed
    np.testing.assert_allclose(after.habit, (1.0 - HABITS) / MOTIONS + HABITS * SAID)


def test_the_style_is_the_least_squares_fit_to_what_was_said(observed):
    """One observation of four motions, beside those that STYLE counts for, weighted half by what was said."""
    begun, after = observed
    weight = 0.5 * SAID + 0.5 / MOTIONS
    features = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
    features -= weight @ features
    wanted = np.log(SAID) - weight @ np.log(SAID)
    normal = KEEP * begun.normal + (1.0 - KEEP) * begun.normal + (features.T * weight) @ features
    moment = KEEP * begun.moment + (1.0 - KEEP) * begun.moment + (features.T * weight) @ wanted
    fitted = np.linalg.solve(normal, moment)
    sharp = fitted[:2].mean()
    assert after.style == pytest.approx([sharp, sharp, -sharp, fitted[3]])
    assert sharp < STYLE[0]  # it said its way less sharply than STYLE does


def test_trust_falls_where_habits_predict_better():
    cost, normal = np.zeros(2), np.eye(4)
    trusts = [Belief(cost, normal, normal[0], SAID, excess, 0.0).trust for excess in (-20.0, DOUBT, 30.0)]
    assert trusts == pytest.approx([1.0, 0.5, 0.0], abs=1e-9)
