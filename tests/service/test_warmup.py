"""What a server compiles before a decision needs it: before it is ready, or soon after."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import gc
import json
from dataclasses import replace
import numpy as np
from numba.core.dispatcher import Dispatcher
from specshield.policy.methods import load_policy
from specshield.policy.planner import policy as planner
from specshield.policy.reachability.policy import synthesise
from specshield.reasons.explanation import explanations
from specshield.reasons.refusal import refusal
from specshield.service import warmup
from specshield import episode
from specshield.shield.decision import Config, make_shield
from specshield.shield.uncertainty import Uncertainty
from specshield.shipped import MODELS
from specshield.sim.cases import load_case
from specshield.task import make_task

def ready():
    kernels = (each for each in gc.get_objects() if isinstance(each, Dispatcher))
    return {(each.py_func.__name__, str(types)) for each in kernels for types in each.overloads}

case = load_case("case1")
policy, logits = synthesise(case.task), np.zeros(20)
for part in warmup.PARTS:
    warmup.warm_up(part)
before = ready()
start = (4.5, 5.0, 0.0)
ending = np.where(case.task.robot.terminal, 0.0, -np.inf)
for threshold, wanted in ((0.5, logits), (0.5, ending), (1.0, ending)):
    episode.decide(make_shield([policy], Config(threshold)), [start], wanted)
ring = [[4.5 + 0.4 * np.cos(a), 5.0 + 0.4 * np.sin(a)] for a in np.arange(0.0, 6.3, 0.1)]
for config in (Config(), Config(uncertainty=Uncertainty(), learn_map=True)):
    shield = make_shield([policy], config)
    first = episode.decide(shield, [start], logits)
    for pose in (start, (4.6, 5.0, 0.0), (5.0, 256.0, 0.0)):
        for more in ({}, {"occupied": ring}, {"free": ring}):
            again = episode.decide(shield, [start, pose], logits, carry=first.carry, **more)
            episode.decide(shield, [start, pose, pose], logits, carry=again.carry)
print("ready:", *sorted({name for name, _ in ready() - before}))

for part in warmup.LATER:
    warmup.warm_up(part)
before = ready()
card = json.loads((MODELS / "case1-dqn" / "card.json").read_text())
learned = load_policy(MODELS / "case1-dqn" / "policy.safetensors", card, case.task)
default = {"uncertainty": Uncertainty(), "learn_map": True}
over = {"threshold_over": "episode", **default}
half = {"threshold": 0.5}
for some in ({}, half, default, {**half, **default}, over, {**half, **over}):
    for each in (policy, learned):
        shield = make_shield([each], Config(**some))
        episode.decide(shield, [start], ending)
        first = episode.decide(shield, [start], logits)
        episode.decide(shield, [start, start], logits, carry=first.carry, occupied=ring, explain=explanations)
robot, grid = case.task.robot, case.task.grid
ahead = replace(robot, actions=tuple(each for each in robot.actions if each.translate >= 0.0))
narrow = {"A": {"type": "circle", "center": [5.5, 5.0], "radius": 0.07}}
wide = {"A": {"type": "circle", "center": [6.5, 5.0], "radius": 0.6}}
for of, regions in ((robot, narrow), (robot, wide), (ahead, wide)):
    task = make_task(grid, of, "F[0,30] A and G[0,40] not (x > 9.5)", regions)
    for made in (synthesise, planner.synthesise)[: 2 if of is robot else 1]:
        shield = make_shield([made(task)], Config(uncertainty=Uncertainty(), learn_map=True))
        first = episode.decide(shield, [start], np.zeros(len(of.actions)), explain=explanations)
        for t in range(1, 14):
            poses = [start] * (t + 1)
            first = episode.decide(shield, poses, np.zeros(len(of.actions)), carry=first.carry)
        refusal(shield, np.array([(1.0, 1.0, 0.0)]), {})
print("complete:", *sorted({name for name, _ in ready() - before}))
"""


def test_no_robot_waits_for_a_compiler():
    """A decision that compiles takes seconds, and everybody else's on that server wait for it."""
    told = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stderr
    assert told.stdout.splitlines() == ["ready:", "complete:"]
