"""Distances along free space, and the goal that is due next."""

from __future__ import annotations

import numpy as np
import pytest

from specshield.policy.dqn.scene import current_goal, distance_to, make_scene, predicates_at
from specshield.policy.progress import BROKEN, PENDING, SETTLED
from tests.policy.rooms import REGIONS, corridor, flat


def test_distances_in_a_corridor_by_hand():
    scene = make_scene(corridor("F[0,9] End"))
    # The cells of the last metre are in End, and the others lie half a metre apart.
    expected = [4.0, 3.5, 3.0, 2.5, 2.0, 1.5, 1.0, 0.5, 0.0, 0.0]
    assert scene.distance.tolist() == [[expected] * 3]
    assert distance_to(scene, 0, 1.25, 0.75) == 3.0  # a centre of a cell
    assert distance_to(scene, 0, 1.35, 0.6) == pytest.approx(2.9)  # between centres
    assert distance_to(scene, 0, 0.05, 1.49) == 4.0  # beyond the outermost centres, as at them


def test_cells_that_an_always_forbids_are_closed_and_count_as_a_detour():
    scene = make_scene(corridor("F[0,9] End and G[0,9] y < 1.0"))
    assert scene.distance[0, 1, 2] == 3.0
    assert scene.distance[0, 2, 2] == 3.0 + 2.0 * 0.5  # from the cell below, and twice the way there
    short = make_scene(corridor("F[0,9] End and G[0,8] y < 1.0"))  # it ends before the goal is due
    late = make_scene(corridor("F[0,9] End and G[1,9] y < 1.0"))  # it begins after the robot does
    assert short.distance[0, 2, 2] == late.distance[0, 2, 2] == 3.0
    nowhere = make_scene(corridor("F[0,9] (End and x < 0)"))
    assert (nowhere.distance == 1e3).all()


def test_what_a_scene_tells_of_its_task():
    scene = make_scene(corridor("G[0,9] theta < 3 and F[2,20] End and F[0,9] x > 2"))
    assert scene.goal.tolist() == [-1, 0, 1]
    assert (scene.centre, scene.half) == ((2.5, 0.75), (2.5, 0.75))
    assert (scene.horizon, scene.stride, scene.wait) == (20, 0.5, 0)
    assert (scene.guards.tolist(), scene.guards_turn) == ([], True)
    scene = make_scene(flat("F[0,9] East and G[0,9] not Hole"))
    assert (scene.guards.tolist(), scene.guards_turn) == ([1], False)  # of East and Hole


def test_predicates_at_poses():
    scene = make_scene(corridor("F[0,9] End and G[0,9] theta < 1"))
    values = predicates_at(scene.rules, np.array([[1.25, 0.75, 0.5], [4.5, 0.75, 2.0]]))
    assert values.tolist() == [[-2.75, 0.5], [0.5, -1.0]]


def test_the_goal_that_is_due_first_is_the_current_one():
    rules = make_scene(corridor("F[0,9] End and G[0,4] x > 0 and F[0,3] G[0,4] x > 1 and F[0,7] x > 2")).rules
    assert rules.last.tolist() == [9, 4, 7, 7]

    def current(*status):
        return current_goal(rules, np.array(status, np.int8))

    assert current(PENDING, PENDING, PENDING, PENDING) == 2  # of two that are due together, the first
    assert current(PENDING, PENDING, SETTLED, PENDING) == 3
    assert current(PENDING, PENDING, SETTLED, BROKEN) == 0
    assert current(SETTLED, PENDING, SETTLED, SETTLED) == -1  # an `always` is no goal


def test_distance_goes_round_walls_and_forbidden_regions():
    """From beside the wall, East is nearer through the door than the straight line says."""
    cells = make_scene(flat("F[0,20] East")).distance[0]
    assert cells[15, 35] == 0.0  # in East
    assert cells[2, 18] > cells[15, 18]  # a cell from the wall, but further from the door
    assert np.isfinite(cells).all()
    gate = {"type": "rectangle", "min": [1.8, 0.0], "max": [2.3, 3.0]}
    shut = flat("F[0,20] East and G[0,20] not Gate", regions={**REGIONS, "Gate": gate})
    assert make_scene(shut).distance[0, 15, 5] > cells[15, 5] + 1.0
