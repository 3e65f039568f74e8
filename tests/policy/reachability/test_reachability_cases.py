"""Reachability on the paper's cases and in a real house: what it certifies holds, and goes on holding."""

from __future__ import annotations

import json

import numpy as np
import pytest

from specshield.episode import Config, decide, make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.policy.reachability.policy import synthesise
from specshield.robot import STRETCH
from specshield.robot.dynamics import simulate
from specshield.sim.cases import case_names, load_case
from specshield.task import make_task
from specshield.world.procthor import load_house
from tests.houses import HOUSES, needs_houses
from tests.oracles.judge import margin

END = STRETCH.action_names.index("end")


def feasible_starts(shield, n, random):
    found = []
    for pose in free_poses(shield.task, shield.body, 20 * n, random):
        try:
            start(shield, pose)
        except InfeasibleStart:
            continue
        found.append(pose)
        if len(found) == n:
            return found
    raise AssertionError("too few feasible starts")


def wander(shield, pose, random, check=None):
    """The states of an episode under a model that always wants the same wrong things, and the modes."""
    wants = random.normal(size=len(STRETCH.actions)) * random.choice([0.0, 3.0, 30.0])
    wants[END] = -12.0
    history, modes, decision = [pose], [], None
    while len(history) <= shield.task.horizon:
        logits = wants + random.normal(size=len(wants))
        carry = None if decision is None else decision.carry
        decision = decide(shield, history, logits, carry=carry, witnesses=check is not None)
        modes.append(decision.mode)
        if decision.completion_action is None:
            break
        if check:
            check(np.array(history), decision)
        action = decision.completion_action if decision.action == END else decision.action
        history.append(decision.next_poses[action])
    return history + [history[-1]] * (shield.task.horizon + 1 - len(history)), modes


@pytest.mark.parametrize("name", case_names())
def test_thirty_wandering_episodes_keep_the_rule_and_never_fall_back(name):
    case = load_case(name)
    policy = synthesise(case.task)
    assert len(policy.weights()) < 10e6
    shield, random = make_shield([policy], Config(seed=3)), np.random.default_rng(5)
    judged = []

    def check(history, decision):
        """A witness, simulated on from where the robot is, keeps the rule by the oracle."""
        if random.random() < 0.97:
            return
        action = random.choice(
            [a for a, found in enumerate(decision.witnesses) if found is not None and a != END]
        )
        motions = STRETCH.motion_of[[action, *decision.witnesses[action]]].astype(np.int64)
        after = np.empty((len(motions), 3))
        simulate(shield.body, history[-1], motions, after)
        judged.append(margin(case.spec, np.concatenate([history, after])))

    for pose in feasible_starts(shield, 30, random):
        history, modes = wander(shield, pose, random, check)
        assert set(modes) <= {"shaped", "prior"}
        assert margin(case.spec, history) > 0.0
    assert len(judged) > 30
    assert min(judged) > 0.0


@needs_houses
def test_a_real_house_with_a_dwell_and_rooms_to_visit():
    sizes = json.loads((HOUSES / "asset-sizes.json").read_text())
    grid, rooms = load_house(json.loads((HOUSES / "house_0.json").read_text()), sizes, 0.05)
    first, second = sorted(rooms)[:2]
    task = make_task(grid, STRETCH, f"F[0,80] G[0,10] {first} and F[80,160] {second}", rooms=rooms)
    shield, random = make_shield([synthesise(task)]), np.random.default_rng(1)
    for pose in feasible_starts(shield, 5, random):
        history, modes = wander(shield, pose, random)
        assert set(modes) <= {"shaped", "prior"}
        inside = {room: task.samples(np.array(history))[room] > 0.0 for room in (first, second)}
        assert any(inside[first][t : t + 11].all() for t in range(81))
        assert inside[second][80:161].any()
