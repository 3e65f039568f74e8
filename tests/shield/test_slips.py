"""A robot that slips, and rules of every form: what a session asks for by default keeps them."""

from __future__ import annotations

import numpy as np
import pytest

from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.policy.planner import policy as planner
from specshield.policy.reachability import policy as reachability
from specshield.robot.dynamics import make_body
from specshield.shield.episode import Config, decide, make_shield, start
from specshield.shield.uncertainty import Uncertainty
from tests.oracles.brute_stl import brute_robustness
from tests.policy.rooms import flat

EPISODES = 12
SLIPS = 0.1  # of the motions do nothing


def played(task, shield, pose, random):
    """The poses of an episode of a model that wanders."""
    history, carry, wants = [pose], None, random.normal(0.0, 2.0, len(task.robot.actions))
    for _ in range(task.horizon):
        wants = 0.7 * wants + random.normal(0.0, 1.0, len(wants))
        decision = decide(shield, history, np.where(task.robot.terminal, -30.0, wants), carry=carry)
        slips = random.random() < SLIPS
        history.append(history[-1] if slips else decision.next_poses[decision.action])
        carry = decision.carry
    return np.array(history)


def kept(task, policy, config):
    shield, body, found = make_shield([policy], config), make_body(task.robot, task.grid), []
    for i in range(EPISODES):
        random = np.random.default_rng([i, 7])
        for pose in free_poses(task, body, 200, random):
            try:
                start(shield, pose)
            except InfeasibleStart:
                continue
            break
        samples = {
            name: values.tolist() for name, values in task.samples(played(task, shield, pose, random)).items()
        }
        found.append(brute_robustness(task.formula, samples) > 0.0)
    return sum(found)


@pytest.mark.parametrize(
    ("rule", "make"),
    [
        ("G[0,40] F[0,30] West", planner),  # a patrol
        ("F[0,35] (East and F[0,35] West)", planner),  # an order
        ("F[0,30] East and G[0,30] (East -> F[0,35] West)", planner),  # a response
        ("F[0,20] West or F[0,35] East", planner),  # a choice
        ("(not East) U[0,35] West", planner),
        ("G[30,36] West", planner),  # a meeting
        ("G[30,36] West", reachability),
    ],
)
def test_slips_are_borne_in_a_rule_of_any_form(rule, make):
    task = flat(rule)
    policy = make.synthesise(task)
    assert kept(task, policy, Config(uncertainty=Uncertainty(slip=SLIPS), seed=3)) == EPISODES
    assert kept(task, policy, Config(seed=3)) < EPISODES  # so it is not a rule that keeps itself
