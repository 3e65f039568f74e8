"""Funnels and rewards by hand (paper, equations 4 and 5, Table I)."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from specshield.policy.dqn.funnel import decay_rate, gamma, make_funnels, reward
from specshield.policy.dqn.scene import make_scene
from specshield.policy.progress import BROKEN, PENDING, SETTLED
from tests.policy.rooms import corridor, flat, in_state

FORMULA = "F[10,20] West and G[0,44] not Hole and F[4,8] G[2,6] East"
# rho_max and min rho of each obligation's predicate
HIGHEST, LOWEST = np.array([0.5, 2.0, 0.4]), np.array([-3.5, -0.5, -3.6])


def prepared(literal):
    task = flat(FORMULA)
    scene = make_scene(task)
    return task, scene, make_funnels(scene, LOWEST, HIGHEST, literal)


def test_the_decay_rate_of_table_1():
    assert decay_rate(4.0, 0.25, 0.5, 5.0) == pytest.approx(
        math.log(15.0) / 5.0
    )  # (4 - 1/4) / (1/2 - 1/4) = 15
    assert decay_rate(4.0, 0.25, 0.5, 0.0) == pytest.approx(math.log(15.0))  # G[0,b]: t* is 1, not 0
    assert decay_rate(1.0, 0.5, 2.0, 3.0) == 0.0  # min rho above gamma_inf: inside the funnel from the start


def test_funnels_of_the_paper_by_hand():
    _, _, funnels = prepared(literal=True)
    assert funnels.gamma_0.tolist() == [4.0, 2.5, 4.0]
    assert funnels.gamma_inf.tolist() == [0.25, 1.0, 0.2]
    assert funnels.clock.tolist() == [0, 0, 0]
    # t*: the middle of [10, 20]; 1 instead of 0 for G[0,44]; the middle of [4 + 2, 8 + 2]
    np.testing.assert_allclose(funnels.rate, [math.log(15) / 15, math.log(1.5), math.log(3.8 / 0.2) / 8])
    assert gamma(funnels, 0, 0) == 4.0
    assert gamma(funnels, 0, 15) == pytest.approx(0.5)  # rho_max at t*: the reward's sign is rho's
    assert gamma(funnels, 0, 30) == pytest.approx(3.75 / 15**2 + 0.25)
    assert gamma(funnels, 1, 1) == pytest.approx(2.0)
    assert gamma(funnels, 2, 8) == pytest.approx(0.4)


def test_the_t_star_of_an_always_that_begins_later_is_its_beginning():
    scene = make_scene(flat("G[6,20] West"))
    funnels = make_funnels(scene, np.array([-3.5]), np.array([0.5]), True)
    assert funnels.rate[0] == pytest.approx(math.log(15) / 6)


def test_our_clocks_start_with_the_windows():
    _, _, funnels = prepared(literal=False)
    assert funnels.clock.tolist() == [10, 0, 6]  # a, a, a + c2
    assert gamma(funnels, 0, 0) == gamma(funnels, 0, 10) == funnels.gamma_0[0]  # still to come: gamma_0
    assert gamma(funnels, 0, 15) == pytest.approx(funnels.rho_max[0])  # t*: half the window later


@pytest.mark.parametrize("literal", [True, False])
def test_every_funnel_narrows_from_gamma_0_to_gamma_inf(literal):
    _, _, funnels = prepared(literal)
    assert (funnels.rate >= 0.0).all()
    assert (funnels.gamma_inf > 0.0).all()
    assert (funnels.gamma_inf < np.minimum(funnels.gamma_0, funnels.rho_max)).all()
    for k in range(3):
        course = [gamma(funnels, k, t) for t in range(200)]
        assert course[0] == funnels.gamma_0[k]
        assert all(later <= earlier for earlier, later in pairwise(course))
        assert course[-1] >= funnels.gamma_inf[k]


def test_the_papers_reward_is_the_least_of_those_whose_window_is_open():
    task, scene, funnels = prepared(literal=True)
    pose = (*task.grid.to_map([1.0, 1.5]), 0.0)

    def literal(t, *status):
        state = in_state(scene, pose, status)
        state.predicates[:] = [0.2, 0.9, -2.0]
        return reward(scene, funnels, t, state)

    # rho + gamma(t) - rho_max of F[10,20], G[0,44] and F[4,8] G[2,6], which is decided at 14
    def first(t):
        return 0.2 + 3.75 / 15 ** (t / 15) + 0.25 - 0.5

    def second(t):
        return 0.9 + 1.5 / 1.5**t + 1.0 - 2.0

    def third(t):
        return -2.0 + 3.8 / 19 ** (t / 8) + 0.2 - 0.4

    pending = [PENDING] * 3
    assert literal(3, *pending) == pytest.approx(second(3))
    assert literal(8, *pending) == pytest.approx(min(second(8), third(8)))
    assert literal(14, *pending) == pytest.approx(third(14))
    assert literal(20, *pending) == literal(20, SETTLED, BROKEN, SETTLED) == pytest.approx(second(20))
    assert literal(12, *pending) == pytest.approx(min(first(12), second(12), third(12)))
    assert literal(45, *pending) == 0.0


def test_the_default_reward_rises_with_progress_and_falls_with_danger():
    task, scene, funnels = prepared(literal=False)

    def default(t, column, status, predicates=(-1.0, 0.5, -1.0)):
        state = in_state(scene, (*task.grid.to_map([column, 1.5]), 0.0), status)
        state.predicates[:] = predicates
        return reward(scene, funnels, t, state)

    # The hold in East is due first (step 14), so with nothing settled it is the goal.
    far, near = (default(5, column, [PENDING] * 3) for column in (1.0, 2.9))
    assert 0.0 <= far < near < 0.5
    one, both = (default(5, 1.0, [first, PENDING, SETTLED]) for first in (PENDING, SETTLED))
    assert near < 0.5 <= one < both == 1.0
    assert default(5, 1.0, [SETTLED, PENDING, SETTLED], [-1.0, 0.06, -1.0]) == pytest.approx(0.4)
    assert default(5, 1.0, [SETTLED, PENDING, SETTLED], [-1.0, -0.3, -1.0]) == pytest.approx(-2.0)


def test_the_default_reward_in_a_corridor_by_hand():
    """The map's farthest cells are 4 m from End, so gamma_0 is 4.15; t* is 9 steps into the window."""
    scene = make_scene(corridor("F[2,20] End"))
    funnels = make_funnels(scene, np.array([-4.0]), np.array([0.5]), False)
    assert (funnels.gamma_0[0], funnels.rho_max[0], funnels.gamma_inf[0]) == (4.15, 0.15, 0.075)
    assert funnels.rate[0] == pytest.approx(math.log(4.075 / 0.075) / 9)
    here = in_state(scene, (1.25, 0.75, 0.0))  # 3 m from End
    assert reward(scene, funnels, 2, here) == pytest.approx(0.5 + 0.5 * (4.15 - 3.0) / 4.15)
    assert reward(scene, funnels, 11, here) == pytest.approx(0.5 + 0.5 * (0.15 - 3.0) / 4.15)  # t*
    there = in_state(scene, (4.25, 0.75, 0.0))
    assert reward(scene, funnels, 0, there) == 0.95  # not settled before its window
    assert reward(scene, funnels, 2, in_state(scene, (4.25, 0.75, 0.0), [SETTLED])) == 1.0
