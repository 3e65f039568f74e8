"""Prints a digest of what is decided along one episode in several settings, for test_portable.py."""

import hashlib

import numpy as np

from evaluation.shipped import shipped
from specshield.episode import decide, make_shield
from specshield.lookahead.lookahead import prepare
from specshield.policy.dqn.environment import free_poses
from specshield.robot.dynamics import make_body
from specshield.shield.decision import Config
from specshield.shield.uncertainty import Uncertainty
from specshield.sim.cases import load_case

STEPS = 40  # after which the look-ahead has weighed some of its decisions
SETTINGS = {
    "projection": Config(),
    "cautious": Config(uncertainty=Uncertainty(), learn_map=True),
    "tilt": Config(evaluation="robustness", threshold=0.05),
    "threshold": Config(threshold=0.9),
    "episode": Config(threshold=0.9, threshold_over="episode"),
    "lookahead": Config(),
}
case = load_case("case1")
policy = shipped(case, "reachability")
body = make_body(case.task.robot, case.task.grid)
begun = next(iter(free_poses(case.task, body, 1, np.random.default_rng(3)))).tolist()
for name, config in SETTINGS.items():
    preference = prepare(case.task, [policy]) if name == "lookahead" else None
    shield, random = make_shield([policy], config, preference), np.random.default_rng(1)
    poses, carry, told = [begun], None, hashlib.sha256()
    for _ in range(STEPS):
        logits = 4.0 * random.normal(size=len(case.task.robot.actions))
        logits[case.task.robot.terminal] = -20.0
        decision = decide(shield, poses, logits, carry=carry)
        carry = decision.carry
        told.update(repr([decision.distribution.tolist(), decision.kl, decision.feasible_mass]).encode())
        told.update(repr([decision.robustness, decision.threshold_left, carry]).encode())
        poses.append(decision.next_poses[decision.action].tolist())
    print(name, told.hexdigest())
