"""The stand-ins in situations made by hand."""

import math

import numpy as np
import pytest

from specshield.lookahead.goals import NO_PATH, UNIT
from specshield.lookahead.surrogate import (
    AHEAD,
    END_CHANCE,
    OTHER,
    PRICE,
    TURN,
    WANDER,
    WANDER_END,
    bearing_of,
    end_chance,
    features_of,
    follow,
    price_left,
    stand_in_for,
)
from specshield.robot.dynamics import make_body
from specshield.world.occupancy import OccupancyGrid
from tests.lookahead.by_hand import EAST, goals_of, make_world, place
from tests.oracles.cells import FORWARD, LEFT, MOTIONS, RIGHT, ROBOT, WAIT

STYLE = np.array([2.0, 2.0, -2.0, -1.0])
NONE = np.zeros(MOTIONS, bool)


@pytest.fixture(scope="module")
def body():
    return make_body(ROBOT, OccupancyGrid(np.zeros((5, 5), bool), 0.2))


def test_the_bearing_is_the_turn_to_the_way(body):
    goals = goals_of(body, (0, UNIT), (0, 0))
    assert bearing_of(goals, 0, 0, 0, 0.0) == pytest.approx(math.pi / 2)
    assert bearing_of(goals, 0, 0, 0, math.pi) == pytest.approx(-math.pi / 2)
    assert math.isnan(bearing_of(goals, 1, 0, 0, 0.0))


def test_the_bearing_counts_from_the_grids_own_yaw():
    turned = make_body(ROBOT, OccupancyGrid(np.zeros((5, 5), bool), 0.2, (0.0, 0.0, 0.5)))
    assert bearing_of(goals_of(turned, (UNIT, 0)), 0, 0, 0, 0.2) == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("motion", "bearing", "blocked", "expected"),
    [
        (FORWARD, 0.0, False, (1, 0, 0, 0)),
        (FORWARD, math.pi / 3, False, (0.5, 0, 0, 0)),
        (FORWARD, math.pi, False, (-1, 0, 0, 0)),
        (FORWARD, 0.0, True, (0, 0, 1, 0)),
        (LEFT, math.pi / 2, False, (0, 1, 0, 0)),  # it leaves nothing of the bearing
        (RIGHT, math.pi / 2, False, (0, -1, 0, 0)),  # it doubles it
        (LEFT, math.pi / 4, False, (0, 0, 0, 0)),  # as far off on the other side
        (WAIT, 0.0, False, (0, 0, 0, 1)),
        (FORWARD, math.nan, False, (0, 0, 0, 0)),  # at the goal
    ],
)
def test_the_features_of_a_motion(body, motion, bearing, blocked, expected):
    assert features_of(body, bearing, motion, blocked) == pytest.approx(expected, abs=1e-12)


def test_one_that_goes_somewhere_says_the_softmax_of_its_features(body):
    """The way is straight ahead: 2 for going there, -2 for either turn, -1 for waiting."""
    log_r = np.empty(MOTIONS)
    end = follow(goals_of(body, (UNIT, 0)), 0, STYLE, (0.5, 0.5, 0.0), NONE, log_r)
    weights = np.exp([2.0, -2.0, -2.0, -1.0])
    np.testing.assert_allclose(np.exp(log_r), weights / weights.sum(), rtol=1e-12)
    assert end == end_chance(300) < 1e-9
    assert end_chance(100) == END_CHANCE / 2
    assert end_chance(0) == pytest.approx(END_CHANCE, rel=1e-4)


def test_one_that_wanders_goes_ahead_where_it_can(body):
    log_r = np.empty(MOTIONS)
    for blocked, ahead in ((NONE, AHEAD), (np.arange(MOTIONS) == FORWARD, 0.0)):
        assert follow(goals_of(body, (UNIT, 0)), WANDER, STYLE, (0.5, 0.5, 0.0), blocked, log_r) == WANDER_END
        weights = np.exp([ahead, TURN, TURN, OTHER])
        np.testing.assert_allclose(np.exp(log_r), weights / weights.sum(), rtol=1e-12)


def test_the_price_of_the_way_that_is_left(body):
    """3 m, of which the last one is near enough to end, in steps of 0.2 m."""
    assert price_left(goals_of(body, (UNIT, 0)), 0, 0.5, 0.5) == pytest.approx(10.0 * PRICE)
    assert price_left(goals_of(body, (UNIT, 0), distance=90), 0, 0.5, 0.5) == 0.0
    assert price_left(goals_of(body, (UNIT, 0), distance=NO_PATH), 0, 0.5, 0.5) == 0.0
    assert price_left(goals_of(body, (UNIT, 0)), WANDER, 0.5, 0.5) == 0.0


def test_a_stand_in_on_the_lattice_is_the_same_as_at_the_pose():
    """In the eastern cell of two, where going on is blocked."""
    body, _, planes = make_world("F[0,1] B")
    goals, log_r = goals_of(body, (UNIT, 0)), np.empty(3)
    stand_in = stand_in_for(goals, planes, 0, STYLE)
    at = place(planes, 1)
    end = follow(goals, 0, STYLE, EAST, np.array([True, False, False]), log_r)
    np.testing.assert_allclose(stand_in.motions[:, 0, at], log_r, rtol=1e-6)
    weights = np.exp([-2.0, -2.0, -1.0])  # blocked; back, away from the goal; standing still
    np.testing.assert_allclose(np.exp(log_r), weights / weights.sum(), rtol=1e-12)
    assert stand_in.ends[0, at] == pytest.approx(end)
    assert stand_in.left[at] == pytest.approx(10.0 * PRICE)
    assert stand_in.price == PRICE
