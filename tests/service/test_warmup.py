"""What is compiled before a server is ready: all that a decision by reachability or a DQN may need later."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import gc
import numpy as np
from numba.core.dispatcher import Dispatcher
from specshield.policy.reachability.policy import synthesise
from specshield.service import warmup
from specshield.shield import episode
from specshield.shield.decision import Config, make_shield
from specshield.shield.uncertainty import Uncertainty
from specshield.sim.cases import load_case

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
print(*sorted({name for name, _ in ready() - before}))
"""


# Others call these with such arguments, so a start compiles them and takes them from the disk.
ON_DISK = {"_gap", "step", "successors", "wrap"}


def test_a_robot_in_trouble_does_not_wait_for_a_compiler():
    """A decision that compiles takes seconds, and everybody else's on that server wait for it."""
    told = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stderr
    assert set(told.stdout.split()) <= ON_DISK
