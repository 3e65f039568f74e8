"""What can be asked of a robot's motions, and which of them take one back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from specshield.policy.undo import (
    IMPOSSIBLE,
    NOT_NEEDED,
    move_back,
    turn_by,
    turning_motion,
    undo_motion,
    undoing_motions,
)
from specshield.robot import STRETCH, robot_from_json
from specshield.robot.dynamics import (
    calmest_motion,
    displacement,
    longest_motions,
    make_body,
    motion_count,
    swing_radius,
)
from specshield.world.occupancy import OccupancyGrid

FREE = OccupancyGrid(np.zeros((40, 40), bool), 0.1)
HALF = math.pi / 2
GO, BACK, LEFT, RIGHT, ARC, WAIT = range(6)
ACTIONS = [
    {"name": "go", "translate": 0.2},
    {"name": "back", "translate": -0.3},
    {"name": "left", "rotate": HALF},
    {"name": "right", "rotate": -HALF},
    {"name": "arc", "translate": 0.1, "rotate": 0.5},
    {"name": "wait"},
]


def body_of(*motions, offset=(0.0, 0.0)):
    actions = [ACTIONS[motion] for motion in motions]
    robot = {"footprint": {"radius": 0.1, "offset": list(offset)}, "actions": actions}
    return make_body(robot_from_json(robot), FREE)


ALL = body_of(GO, BACK, LEFT, RIGHT, ARC, WAIT)


def test_how_many_there_are_and_how_far_they_lead():
    assert motion_count(ALL) == 6
    assert displacement(ALL, BACK) == (-0.3, 0.0)
    assert displacement(ALL, ARC) == (0.1, 0.5)
    assert longest_motions(ALL) == (0.3, HALF)
    assert longest_motions(body_of(LEFT)) == (0.0, HALF)


def test_how_far_the_footprint_reaches():
    assert swing_radius(ALL) == 0.1
    assert swing_radius(body_of(GO, offset=(0.3, -0.4))) == pytest.approx(0.6)


def test_which_motion_stands_still_or_comes_nearest():
    assert calmest_motion(ALL) == WAIT
    assert calmest_motion(body_of(GO, LEFT)) == 1  # a turn on the spot
    assert calmest_motion(body_of(BACK, GO)) == 1  # the shorter move
    assert STRETCH.motions[STRETCH.wait_motion] == (0.0, 0.0)
    assert robot_from_json({"footprint": {"radius": 0.1}, "actions": ACTIONS[:5]}).wait_motion == -1


def test_which_robots_go_back():
    assert STRETCH.goes_back
    forward = {"footprint": {"radius": 0.1}, "actions": [ACTIONS[GO], ACTIONS[ARC]]}
    assert not robot_from_json(forward).goes_back


def test_which_robots_turn_in_place():
    assert turning_motion(body_of(GO, LEFT)) == 1
    assert turning_motion(body_of(GO, ARC, WAIT)) == -1


def test_a_turn_by_an_angle_does_nothing_else():
    assert turn_by(ALL, HALF) == LEFT
    assert turn_by(ALL, -3 * HALF) == LEFT  # the same angle
    assert turn_by(ALL, 0.0) == NOT_NEEDED
    assert turn_by(ALL, 0.5) == IMPOSSIBLE  # the arc moves, too


def test_the_move_that_comes_nearest_to_where_it_was():
    assert move_back(ALL, GO, 0.2) == BACK  # 0.1 m too far, nearer than staying
    assert move_back(ALL, BACK, 0.3) == GO
    assert move_back(ALL, BACK, 0.05) == NOT_NEEDED  # stopped at once: 0.2 m ahead would lead farther off
    assert move_back(body_of(GO, LEFT), 0, 0.2) == NOT_NEEDED  # it has no move back


def test_the_motion_that_leads_from_one_pose_back_to_another():
    here = np.array([2.0, 2.0, 0.0])
    assert undo_motion(ALL, here, np.array([2.0, 2.0, HALF])) == RIGHT
    assert undo_motion(ALL, here, here) == NOT_NEEDED
    assert undo_motion(ALL, here, np.array([2.3, 2.0, 0.0])) == BACK
    assert undo_motion(ALL, here, np.array([2.2, 2.0, 0.0])) == IMPOSSIBLE  # back is 0.3 m


def test_the_two_motions_that_undo_each():
    robot = robot_from_json({"footprint": {"radius": 0.1}, "actions": ACTIONS})
    assert undoing_motions(robot).tolist() == [
        [BACK, NOT_NEEDED],
        [GO, NOT_NEEDED],
        [RIGHT, NOT_NEEDED],
        [LEFT, NOT_NEEDED],
        [NOT_NEEDED, NOT_NEEDED],  # no turn is near 0.5 rad, no move near 0.1 m back
        [NOT_NEEDED, NOT_NEEDED],
    ]
