"""The preferences that a session can name in `shaping`, beside "projection", which is none."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from specshield.lookahead.lookahead import prepare as look_ahead
from specshield.shield.preference import Preference
from specshield.shield.proposal import Proposer
from specshield.task import Task

PROJECTION = "projection"
PREFERENCES: dict[str, Callable[[Task, Sequence[Proposer]], Preference]] = {"lookahead": look_ahead}


def prepare(name: str, task: Task, proposers: Sequence[Proposer], pose: Sequence[float]) -> Preference:
    """The preference of that name for a task, ready for its first step: its kernels are compiled.

    pose: any pose (x, y, theta) of the robot's. Raises what the preference raises for a task that it does not
    cover, such as FragmentError or Unsupported.
    """
    preference = PREFERENCES[name](task, proposers)
    actions = len(task.robot.actions)
    signals = {signal: np.array([value]) for signal, value in task.signals.items()}
    even = np.full(actions, -math.log(actions))
    preference.step(preference.begin(), np.array([pose], dtype=np.float64), signals, even)
    return preference
