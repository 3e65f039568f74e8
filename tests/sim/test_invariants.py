"""Once feasible, always feasible: episodes without mismatch under priors that mean well, badly, or nothing.

The shield is asked directly; whether the rule was kept is decided by the brute-force oracle.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from specshield.episode import decide, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.shield.shaping import log_softmax
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import SimulatedRobot
from tests.oracles.judge import margin

EPISODES = {  # 132 of them; learned policies take longer to ask
    ("case1", "dqn"): 32, ("case2", "dqn"): 20, ("case1", "reachability"): 40, ("case2", "reachability"): 40,
}  # fmt: skip


class Noise:
    """Logits of any sharpness that mean nothing."""

    def __init__(self, case, random):
        self.random, self.scale = random, random.choice([0.0, 1.0, 5.0, 30.0])

    def logits(self, robot, decision):
        return self.random.normal(size=20) * self.scale - np.eye(20)[4] * 12.0


class Saboteur:
    """Wants what the last decision found worst for the rule, by a margin no float exponential survives."""

    def __init__(self, case, random):
        self.random, self.weight = random, random.choice([10.0, 300.0, 1e5])

    def logits(self, robot, decision):
        wish = self.random.normal(size=20)
        if decision is not None:
            wish -= self.weight * np.array([v or 0.0 for v in decision.robustness])
            wish -= self.weight * np.array([v or 0.0 for v in decision.j_values])
        wish[4] = wish.max() - 8.0
        return wish


class Idler:
    """All but never moves."""

    def __init__(self, case, random):
        self.random = random

    def logits(self, robot, decision):
        return np.where(np.arange(20) == 5, 40.0, self.random.normal(size=20))


class Seeker:
    """The stand-in model: its target, and an `end` there."""

    def __init__(self, case, random):
        self.model = GoalSeeker(case.task.robot)
        self.model.reset(random)

    def logits(self, robot, decision):
        return self.model.logits(robot)


PRIORS = (Noise, Saboteur, Idler, Seeker)


def episode(case, shield, i):
    """Modes seen, decisions made, and rho by the oracle; None for a start that is refused."""
    random = np.random.default_rng([i, 7])
    (pose,) = free_poses(case.task, shield.body, 1, random).tolist()
    try:
        start(shield, pose)
    except InfeasibleStart:
        return None
    robot, prior = SimulatedRobot(case, tuple(pose)), PRIORS[i % len(PRIORS)](case, random)
    terminal, history, modes = case.task.robot.terminal, [], set()
    decision, over = None, False
    while len(history) <= case.task.horizon:
        history.append(robot.pose)
        logits = None if over else prior.logits(robot, decision)
        decision = decide(shield, history, logits, over, carry=None if decision is None else decision.carry)
        modes.add(decision.mode)
        check(decision, logits, terminal, case.task.horizon)
        action = int(random.choice(20, p=decision.distribution))
        if terminal[action]:
            over, action = True, decision.completion_action
        if decision.completion_action is None:  # settled
            break
        robot.execute(action)
        assert robot.pose == tuple(decision.next_poses[action])
    history += [robot.pose] * (case.task.horizon + 1 - len(history))
    return modes, margin(case.spec, history)


def check(decision, logits, terminal, horizon):
    """What holds of every decision."""
    p = decision.distribution
    assert np.all(p >= 0.0)
    assert p.sum() == pytest.approx(1.0, abs=1e-12)
    assert decision.spec_status != "violated"
    if decision.mode == "prior":
        return
    assert decision.mode in ("shaped", "completion")
    feasible = np.array(decision.j_values) == 1.0
    assert feasible[~terminal].any(), "feasible before, and no longer"
    assert np.all(p[~feasible] == 0.0), "mass outside S_t"
    assert all(rho > 0.0 for rho, ok in zip(decision.robustness, feasible & ~terminal, strict=True) if ok)
    if logits is None:
        assert p[decision.completion_action] == 1.0
    else:
        assert p[terminal] == pytest.approx(np.exp(log_softmax(logits))[terminal], abs=1e-15)
        if p[~terminal].max() > 1e-12:  # the prior on S_t, renormalised
            inside = log_softmax(np.where(feasible & ~terminal, logits, -np.inf))
            expected = (1.0 - p[terminal]) * np.exp(inside)
            assert p[~terminal] == pytest.approx(expected[~terminal], rel=1e-9, abs=1e-12)


def test_once_feasible_always_feasible_whatever_the_model_wants(case, shield):
    n = EPISODES[case.name, shield.proposers[0].card["method"]]
    with ThreadPoolExecutor(2) as threads:
        outcomes = list(threads.map(lambda i: episode(case, shield, i), range(n)))
    ran = [outcome for outcome in outcomes if outcome is not None]
    assert len(ran) >= 0.95 * n
    assert all(rho > 0.0 for _, rho in ran)
    assert set().union(*(modes for modes, _ in ran)) >= {"shaped", "prior"}


def test_a_model_that_rules_out_every_way_still_keeps_the_rule(case, shield):
    """All but one action null: where that one cannot be, the certified continuation is taken, and said."""
    random = np.random.default_rng(3)
    for pose in free_poses(case.task, shield.body, 10, random).tolist():
        try:
            start(shield, pose)
            break
        except InfeasibleStart:
            continue
    robot, history, decision, reasons = SimulatedRobot(case, tuple(pose)), [], None, set()
    while len(history) < case.task.horizon:
        history.append(robot.pose)
        logits = np.where(np.arange(20) == random.integers(20), 0.0, -np.inf)
        decision = decide(shield, history, logits, carry=None if decision is None else decision.carry)
        if decision.mode == "fallback":
            reasons.add(decision.reason)
            assert decision.kl is None
        moved = decision.completion_action if decision.action == 4 else decision.action
        robot.execute(4 if moved is None else moved)
    history.append(robot.pose)
    assert reasons == {"zero_prior_mass"}
    assert margin(case.spec, history) > 0.0
