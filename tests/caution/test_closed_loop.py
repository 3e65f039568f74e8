"""A trained policy in the closed loop: once feasible, always feasible, judged by a brute-force evaluator."""

from __future__ import annotations

import numpy as np
import pytest

from specshield.episode import Config, decide, make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.policy.dqn.method import Settings
from specshield.policy.dqn.train import train
from specshield.policy.methods import Run
from specshield.robot.dynamics import in_collision, make_body, successors
from specshield.world.regions import signed_distance
from tests.oracles.brute_stl import brute_robustness
from tests.policy.rooms import flat

EPISODES = 200
TASK = flat("F[0,12] West and F[8,20] not West and G[0,10] not Hole")


@pytest.fixture(scope="module")
def policy():
    settings = Settings(
        units=32, updates=400, robots=128, batch=256, learning_rate=2e-3, discount=0.95, polyak=0.02,
        replay=80_000, evaluate_every=200, evaluation_starts=100,
    )  # fmt: skip
    return train(TASK, settings, Run())


def keeps(history):
    points = np.array(history)[:, :2]
    samples = {name: signed_distance(region, points).tolist() for name, region in TASK.regions.items()}
    return brute_robustness(TASK.formula, samples) > 0


def test_once_feasible_always_feasible(policy):
    """A model that wanders, no mismatch: every episode keeps the rule, and none needs a fallback."""
    shield, random = make_shield([policy], Config(seed=7)), np.random.default_rng(0)
    end = TASK.robot.action_names.index("end")
    played, modes, one_hot = 0, [], 0
    for pose in free_poses(TASK, shield.body, 5000, random):
        try:
            start(shield, pose)
        except InfeasibleStart:
            continue
        history, carry, done = [pose], None, False
        wants = random.normal(0, 2, len(TASK.robot.actions))
        wants[end] = 0.0
        for _ in range(TASK.horizon):
            logits = wants + random.normal(0, 1, len(wants))
            decision = decide(shield, history, None if done else logits, done, carry=carry)
            done = done or decision.action == end
            if decision.completion_action is None:
                action = decision.action
            else:
                action = decision.completion_action if decision.action == end else decision.action
            assert decision.mode in ("shaped", "completion", "prior")
            assert decision.residual in (None, (0.0, 0.0))
            assert not decision.in_collision
            one_hot += decision.mode == "shaped" and decision.distribution.max() == 1.0
            modes.append(decision.mode)
            history.append(decision.next_poses[action])
            carry = decision.carry
        assert keeps(history)
        assert not any(in_collision(shield.body, *pose) for pose in history)
        played += 1
        if played == EPISODES:
            break
    assert played == EPISODES
    assert min(modes.count(mode) for mode in ("shaped", "completion", "prior")) > 100
    assert one_hot < 0.2 * modes.count("shaped")


def test_unshielded_the_same_model_breaks_the_rule():
    """So the rule above is not one that keeps itself."""
    body, random = make_body(TASK.robot, TASK.grid), np.random.default_rng(0)
    nexts, kept = np.empty((len(TASK.robot.motions), 3)), 0
    for pose in free_poses(TASK, body, 100, random):
        history, wants = [pose], random.normal(0, 2, len(TASK.robot.actions))
        for _ in range(TASK.horizon):
            successors(body, history[-1], nexts)
            motion = TASK.robot.motion_of[np.argmax(wants + random.gumbel(size=len(wants)))]
            history.append(nexts[motion].copy() if motion >= 0 else history[-1])
        kept += keeps(history)
    assert kept < 20
