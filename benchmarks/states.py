"""The states that are decided: starts, and states along episodes of the stand-in model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evaluation.shipped import shipped
from specshield.episode import Carry, Shield, decide, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.policy.dqn.policy import Policy
from specshield.sim.cases import Case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import SimulatedRobot

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """What a decision is asked: history [t + 1, 3], logits [A] or None, what the last decision handed on."""

    history: Floats
    logits: Floats | None
    carry: Carry | None

    @property
    def t(self) -> int:
        return len(self.history) - 1


def shipped_dqn(case: Case) -> Policy:
    policy = shipped(case, "dqn")
    assert isinstance(policy, Policy)
    return policy


def starts(shield: Shield, n: int, seed: int) -> list[State]:
    """n states at t = 0, uniform over free space; those that a session would be refused are left out."""
    random = np.random.default_rng([seed, 10])
    kept: list[State] = []
    poses = iter(free_poses(shield.task, shield.body, 20 * n + 100, random))
    while len(kept) < n:
        pose = next(poses)
        try:
            start(shield, pose.tolist())
        except InfeasibleStart:
            continue
        kept.append(State(pose[None], random.normal(size=len(shield.task.robot.actions)), None))
    return kept


def along(case: Case, shield: Shield, episodes: int, seed: int) -> list[State]:
    """Every state of some episodes, t > 0, at which the rule is pending."""
    model, found = GoalSeeker(case.task.robot), list[State]()
    for episode, first in enumerate(starts(shield, episodes, seed + 1)):
        robot = SimulatedRobot(case, tuple(first.history[0].tolist()))
        model.reset(np.random.default_rng([seed, episode]))
        poses, over, carry = [robot.pose], False, None
        while len(poses) <= case.task.horizon:
            logits = None if over else model.logits(robot)
            decision = decide(shield, poses, logits, over, carry=carry)
            if decision.spec_status != "pending":
                break
            if len(poses) > 1:
                found.append(State(np.array(poses), logits, carry))
            over = over or bool(case.task.robot.terminal[decision.action])
            robot.execute(decision.completion_action if over else decision.action)
            poses.append(robot.pose)
            carry = decision.carry
    return found
