"""Rollouts by hand in the corridor, and what they promise in the flat."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from specshield.policy.card import make_card
from specshield.policy.dqn.environment import free_poses
from specshield.policy.dqn.network import NAMES, make_network
from specshield.policy.dqn.policy import Policy
from specshield.policy.dqn.rollout import satisfies
from specshield.robot import STRETCH
from specshield.robot.dynamics import simulate
from specshield.stl import robustness
from tests.policy.rooms import CUSTOM, corridor, flat, random_policy, sizes

WAIT, GO, LEFT, RIGHT = range(4)


def always_going(formula):
    """A policy whose network prefers to go, whatever it sees."""
    task = corridor(formula)
    inputs, outputs = sizes(task)
    shapes = [(inputs, 1), (1,), (1, 1), (1,), (1, outputs), (outputs,)]
    weights = {name: np.zeros(shape, np.float32) for name, shape in zip(NAMES, shapes, strict=True)}
    weights["b3"][GO] = 1.0
    return Policy(task, make_card(task, "dqn", {}, 0, {}), make_network(weights, inputs, outputs))


def rows(policy, pose):
    proposal = policy.propose(np.array([pose]), {}, 0.0)
    assert proposal.preferred == GO
    return proposal.motions.tolist()


def test_a_corridor_by_hand():
    """End is six steps away. What is left of ten steps is waited, or given to joining the same way."""
    policy, start = always_going("F[0,10] End"), (1.25, 0.75, 0.0)
    way = [GO] * 6
    assert rows(policy, start) == [
        [WAIT, *way, WAIT, WAIT, WAIT],
        [*way, WAIT, WAIT, WAIT, WAIT],
        [LEFT, RIGHT, *way, WAIT, WAIT],
        [RIGHT, LEFT, *way, WAIT, WAIT],
    ]
    literal = rows(replace(policy, literal=True), start)
    assert literal[:2] == [[WAIT, *way, WAIT, WAIT, WAIT], [*way, WAIT, WAIT, WAIT, WAIT]]
    assert literal[2:] == [[turn, *[GO] * 9] for turn in (LEFT, RIGHT)]  # it goes against the wall


def test_where_no_way_comes_in_time_the_motion_is_undone_which_misses_the_least():
    policy, start = always_going("F[0,7] End"), (1.25, 0.75, 0.0)
    assert rows(policy, start) == [
        [WAIT, *[GO] * 6],
        [*[GO] * 6, WAIT],
        [LEFT, RIGHT, *[GO] * 5],  # a step too late; the policy's own would go ahead to where LEFT looks
        [RIGHT, LEFT, *[GO] * 5],
    ]


def test_from_where_the_formula_is_kept():
    policy = always_going("F[0,10] End")
    starts = np.array([[1.25, 0.75, 0.0], [1.25, 0.75, math.pi / 2], [1.25, 0.75, math.pi]])
    assert satisfies(policy.scene, policy.network, starts, False).tolist() == [True, False, False]
    assert satisfies(policy.scene, policy.network, starts, True).tolist() == [True, True, False]  # one turn
    late = always_going("F[0,5] End")
    assert not satisfies(late.scene, late.network, starts, True).any()


def test_a_rollout_reports_what_the_robustness_says():
    task = flat("F[1,12] West and G[0,12] not Hole")
    starts, kept = free_poses(task, random_policy(task).scene.body, 400, np.random.default_rng(0)), []
    for i, pose in enumerate(starts[task.samples(starts)["West"] > -0.2]):
        policy = replace(random_policy(task, i), literal=True)
        proposal = policy.propose(pose[None], {}, 0.0)
        rho = futures_robustness(policy, pose, proposal.motions)
        own, some = (bool(satisfies(policy.scene, policy.network, pose[None], first)[0]) for first in (0, 1))
        assert own == (rho[proposal.preferred] > 0)
        assert some == (rho.max() > 0)
        kept.append(own)
    assert min(kept.count(True), kept.count(False)) > 10


def futures(policy, pose, motions):
    """The poses [N, T - t, 3] after motions [N, T - t], simulated one row at a time."""
    poses = np.empty((*motions.shape, 3))
    for row, way in zip(motions, poses, strict=True):
        simulate(policy.scene.body, pose, row, way)
    return poses


def futures_robustness(policy, pose, motions):
    joint = np.insert(futures(policy, pose, motions), 0, pose, axis=1)
    return robustness(policy.task.formula, policy.task.samples(joint))


@pytest.mark.parametrize("robot", [STRETCH, CUSTOM], ids=["stretch", "custom"])
def test_proposals_go_on_as_they_began(robot):
    """The rollout that certifies an action and the one taken later are the same, bit for bit."""
    task = flat(robot=robot)
    policy, again = random_policy(task, 3), random_policy(task, 3)
    history = free_poses(task, policy.scene.body, 1, np.random.default_rng(2))
    for t in range(12):
        proposal, other = policy.propose(history, {}, 0.0), again.propose(history, {}, 0.0)
        assert proposal.motions.shape == (len(robot.motions), task.horizon - t)
        assert (proposal.motions == other.motions).all()
        assert proposal.preferred == other.preferred
        assert proposal.motions[:, 0].tolist() == list(range(len(robot.motions)))
        following = proposal.motions[proposal.preferred]
        next_pose = futures(policy, history[-1], following[None, :1])[0]
        history = np.vstack([history, next_pose])
        onward = policy.propose(history, {}, 0.0)
        assert onward.preferred == following[1]
        assert (onward.motions[onward.preferred] == following[1:]).all()


def test_to_undo_a_motion_and_go_on_certifies_no_less_than_the_policy_itself():
    task = flat("F[1,12] West and G[0,12] not Hole")
    retraced, more = 0, 0
    starts = free_poses(task, random_policy(task).scene.body, 400, np.random.default_rng(0))
    for i, pose in enumerate(starts[task.samples(starts)["West"] > -0.2]):
        policy = random_policy(task, i)
        literal = replace(policy, literal=True).propose(pose[None], {}, 0.0)
        proposal = policy.propose(pose[None], {}, 0.0)
        own = (proposal.motions == literal.motions).all(axis=1)
        assert proposal.preferred == literal.preferred
        assert own[proposal.preferred]
        rho = [futures_robustness(policy, pose, each.motions) for each in (literal, proposal)]
        assert (rho[1][own] == rho[0][own]).all()
        kept = [each > 0.0 for each in rho]
        assert (kept[1] | ~kept[0]).all()
        retraced, more = retraced + (kept[1] & ~own).sum(), more + (kept[1] & ~kept[0]).sum()
    assert retraced > 50
    assert more > 10


def test_a_broken_obligation_does_not_end_what_is_pending():
    """With one goal missed for good, the rollouts still move on to the other."""
    task = flat("F[0,2] East and F[10,40] West")
    policy, wait = random_policy(task, 1), STRETCH.wait_motion
    history = np.tile(free_poses(task, policy.scene.body, 1, np.random.default_rng(4)), (4, 1))
    assert task.samples(history)["East"].max() < 0
    assert (policy.propose(history, {}, 0.0).motions[:, 1:] != wait).any()
    broken = flat("F[0,2] East and G[0,40] not Hole")
    settled = flat("F[0,2] not Hole and F[0,40] not Hole")
    assert (random_policy(broken, 1).propose(history, {}, 0.0).motions[:, 1:] != wait).any()
    assert (random_policy(settled, 1).propose(history, {}, 0.0).motions[:, 1:] == wait).all()
