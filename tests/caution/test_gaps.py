"""A robot that cannot drive backwards goes where there is room, if the rule can be kept there too.

A room of 4 x 3 m with a wall across. Straight ahead of the robot a gap leads through it that leaves 3 cm on
both sides; another one, a metre to the side, is 1 m wide.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from safetensors.numpy import load, save

from specshield.caution.noise import Care
from specshield.caution.room import ROOM
from specshield.caution.taught import Taught, wary
from specshield.episode import Config, decide, make_shield
from specshield.errors import PolicyError
from specshield.policy.reachability.policy import load_reachability, synthesise
from specshield.reasons.explanation import explanations
from specshield.robot import STRETCH, Action
from specshield.robot.dynamics import make_body
from specshield.shield.uncertainty import Uncertainty
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid

TURN = np.radians(30.0)
OTHERS = (Action("left", rotate=TURN), Action("right", rotate=-TURN), Action("wait"))
ACTIONS = (Action("on", 0.2), *OTHERS, Action("end", terminal=True))
FORWARD = replace(STRETCH, radius=0.22, offset=(-0.06, 0.0), on_contact="stop", actions=ACTIONS)
BACK = replace(FORWARD, actions=(*FORWARD.actions, Action("back", -0.2)))
START, ON = (1.0, 0.75, 0.0), 0
GOAL = {"type": "circle", "center": [3.4, 0.75], "radius": 0.3}


@cache
def policy(robot=FORWARD, steps=70, wide=True):
    """A cell is 5 cm. The gap ahead is 0.5 m wide, from y = 0.5 m to 1.0 m."""
    occupied = np.zeros((60, 80), bool)
    occupied[:, 38:42] = True
    occupied[10:20, 38:42] = False
    if wide:
        occupied[35:55, 38:42] = False
    return synthesise(make_task(OccupancyGrid(occupied, 0.05), robot, f"F[0,{steps}] Goal", {"Goal": GOAL}))


def shield_of(made, **config):
    return make_shield([made], Config(**({"uncertainty": Uncertainty(), "learn_map": True} | config)))


@pytest.mark.parametrize(("robot", "least"), [(FORWARD, 20 + 2 * 6), (BACK, 20)])
def test_time_is_kept_to_turn_round_twice_where_the_robot_cannot_drive_backwards(robot, least):
    assert wary(shield_of(policy(robot)), Care(0.0, 0), Taught(), True).least == least


def way_of(shield):
    """The poses on the way that completes the rule in an exact world, and the last decision."""
    poses, carry = [START], None
    while True:
        decision = decide(shield, poses, None, main_task_done=True, carry=carry)
        if decision.spec_status != "pending" or len(poses) > shield.task.horizon:
            return np.array(poses), decision.spec_status
        carry = decision.carry
        poses.append(tuple(decision.next_poses[decision.action]))


def crossing(poses):
    """Where the robot crosses the wall [m]."""
    return poses[np.argmin(np.abs(poses[:, 0] - 2.0)), 1]


def test_it_goes_round_by_the_wide_gap():
    poses, status = way_of(shield_of(policy()))
    assert status == "satisfied"
    assert crossing(poses) > 1.75 + FORWARD.radius


@pytest.mark.parametrize(
    ("of", "config"),
    [
        ({}, {"uncertainty": None, "learn_map": False}),  # as in the paper
        ({}, {"learn_map": False}),  # the map is known to be right
        ({"robot": BACK}, {}),
        ({"steps": 20}, {}),  # there is no time to go round
        ({"steps": 28}, {}),  # there is, with 3 steps to spare in place of 14
        ({"wide": False}, {}),
    ],
)
def test_it_takes_the_narrow_gap_where_nothing_speaks_against_it_or_no_other_way_keeps_the_rule(of, config):
    poses, status = way_of(shield_of(policy(**of), **config))
    assert status == "satisfied"
    assert 0.5 < crossing(poses) < 1.0


def test_on_its_way_nothing_is_nearer_than_that():
    poses, _ = way_of(shield_of(policy()))
    body = make_body(FORWARD, policy().task.grid)
    wide = body._replace(radius=body.radius + ROOM - 1e-6)
    from specshield.robot.dynamics import in_collision

    assert not any(in_collision(wide, *pose) for pose in poses)


def test_an_action_that_leads_into_the_narrow_gap_is_forbidden_and_says_why():
    shield = shield_of(policy())
    at = (1.62, 0.75, 0.0)
    found = decide(shield, [at], np.zeros(5), explain=explanations)
    assert found.j_values[ON] == 0.0
    assert found.feasible_mass > 0.0
    assert f"closer than {ROOM:g} m to an obstacle" in found.explanations[ON].detail
    free = decide(shield_of(policy(), learn_map=False, uncertainty=None), [at], np.zeros(5))
    assert free.j_values[ON] == 1.0


def test_tables_for_ways_with_room_come_back_from_a_policy_s_file():
    made = policy()
    again = load_reachability(made.weights(), made.card, made.task)
    history = np.array([START])
    kept, found = (each.keeping_clear().propose(history, {}, 0.0).motions for each in (made, again))
    assert np.array_equal(kept, found)
    assert not np.array_equal(kept, made.propose(history, {}, 0.0).motions)
    assert policy(BACK).keeping_clear() is policy(BACK)
    assert load_reachability(policy(BACK).weights(), policy(BACK).card, policy(BACK).task).wide is None


def test_a_threshold_for_the_episode_gives_such_an_action_no_mass_either():
    shield = shield_of(policy(), threshold=1.0, threshold_over="episode")
    found = decide(shield, [(1.62, 0.75, 0.0)], np.zeros(5))
    assert found.mode == "shaped"
    assert found.distribution[ON] == 0.0


def test_a_file_that_lacks_some_of_these_tables_says_which():
    tensors = load(policy().weights())
    del tensors["wide_code"]
    with pytest.raises(PolicyError, match="wide_code"):
        load_reachability(save(tensors), policy().card, policy().task)
