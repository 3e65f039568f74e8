"""Look-ahead shaping in a session's decisions: the same guarantee, another preference."""

from dataclasses import replace

import numpy as np
import pytest

from evaluation.shipped import shipped
from specshield.episode import close, decide, make_shield, start
from specshield.lookahead import lookahead
from specshield.lookahead.lookahead import FORCED, prepare
from specshield.policy.dqn.environment import free_poses
from specshield.portable import exp
from specshield.service.sessions.state import State
from specshield.shield.decision import Config
from specshield.shield.shaping import log_softmax
from specshield.sim.cases import load_case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import SimulatedRobot


@pytest.fixture(scope="module")
def world():
    case = load_case("case1")
    return case, make_shield([shipped(case, "reachability")])


def begin(case, shield, seed):
    (pose,) = free_poses(case.task, case.body, 1, np.random.default_rng([seed, 2])).tolist()
    start(shield, pose)  # raises where it is not feasible
    return pose


def stored(carry):
    return State(1, 1, True, "pending", 0.0, b"", carry=carry).packed()


def loaded(carry):
    return State.of(stored(carry)).carry


def episode(case, shield, seed, each=lambda decision, logits: None):
    """(path KL, verdict) of the stand-in model under the shield."""
    model, robot = GoalSeeker(case.task.robot), SimulatedRobot(case, tuple(begin(case, shield, seed)))
    model.reset(np.random.default_rng([seed, 0]))
    history, carry, over, paid = [], None, False, 0.0
    for _ in range(case.task.horizon + 1):
        history.append(robot.pose)
        logits = None if over else model.logits(robot)
        decision = decide(shield, history, logits, over, carry=carry)
        each(decision, logits)
        paid += decision.kl or 0.0
        carry = loaded(decision.carry)
        over = over or bool(case.task.robot.terminal[decision.action])
        if len(history) <= case.task.horizon:
            robot.execute(
                decision.completion_action
                if over and decision.completion_action is not None
                else decision.action
            )
    return paid, close(shield, history)[0]


def test_the_guarantee_stays_and_the_path_costs_less(world):
    case, shield = world
    ahead = replace(shield, preference=prepare(shield.task, shield.proposers))
    differs = []

    def check(decision, logits):
        if decision.mode != "shaped":
            return
        prior, terminal = exp(log_softmax(logits)), case.task.robot.terminal
        allowed = (np.array(decision.j_values) == 1.0) | terminal
        assert np.all(decision.distribution[~allowed] == 0.0)
        assert np.array_equal(decision.distribution[terminal], prior[terminal])
        projected = np.where(terminal | allowed, prior, 0.0)
        differs.append(np.abs(decision.distribution - projected / projected.sum()).max())

    seeds = range(4)
    with_it = [episode(case, ahead, seed, check) for seed in seeds]
    without = [episode(case, shield, seed) for seed in seeds]
    assert all(verdict == "satisfied" for _, verdict in with_it + without)
    assert max(differs) > 0.1
    assert sum(paid for paid, _ in with_it) < sum(paid for paid, _ in without)


def test_a_run_that_the_rule_hardly_touches_is_as_with_projection(world):
    case, shield = world
    ahead = replace(shield, preference=prepare(shield.task, shield.proposers))
    plain = {seed: distributions(case, shield, seed) for seed in range(3)}
    for seed, (given, paid) in plain.items():
        also, _ = distributions(case, ahead, seed)
        forced = np.cumsum(paid)
        untouched = int(np.searchsorted(forced, FORCED))  # decisions before the rule has cost that much
        assert untouched > 0
        np.testing.assert_array_equal(also[:untouched], given[:untouched])
        assert not np.array_equal(also, given)


def distributions(case, shield, seed):
    """Every distribution of an episode, and the KL of each."""
    given, paid = [], []

    def keep(decision, logits):
        given.append(decision.distribution)
        paid.append(decision.kl or 0.0)

    episode(case, shield, seed, keep)
    return np.array(given), np.array(paid)


def test_a_decision_made_again_is_the_same(world):
    case, shield = world
    ahead = replace(shield, config=Config(seed=4), preference=prepare(shield.task, shield.proposers))
    model, robot = GoalSeeker(case.task.robot), SimulatedRobot(case, tuple(begin(case, ahead, 1)))
    model.reset(np.random.default_rng(1))
    history, carry = [], None
    for t in range(12):
        history.append(robot.pose)
        logits = model.logits(robot)
        decision = decide(ahead, history, logits, carry=carry)
        other = ahead
        if t == 6:  # as in another process
            lookahead._prepare.cache_clear()
            other = replace(ahead, preference=prepare(shield.task, shield.proposers))
        again = decide(other, history, logits, carry=None if carry is None else loaded(carry))
        assert np.array_equal(decision.distribution, again.distribution)
        assert decision.action == again.action
        assert stored(decision.carry) == stored(again.carry)
        carry = decision.carry
        robot.execute(decision.action)
    assert carry.memory is not None
