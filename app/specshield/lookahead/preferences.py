"""The preferences that a session can name in `shaping`, beside "projection", which is none.

To add one: a file that defines a `PreferenceKind`, and a line below (or an entry point of the group
`specshield.preferences` in a package of its own).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from specshield.errors import FragmentError, InputError
from specshield.registry import Registry
from specshield.shield.preference import Preference
from specshield.shield.proposal import Proposer
from specshield.task import Task

PROJECTION = "projection"
AHEADS = 8  # tasks that a process keeps prepared


@dataclass(frozen=True)
class PreferenceKind:
    """A kind of preference.

    about: one sentence. prepare(task, proposers): the preference for a task whose policies are `proposers`;
    it may take seconds, and raises FragmentError or Unsupported for a task that it does not cover.
    """

    about: str
    prepare: Callable[[Task, Sequence[Proposer]], Preference]


PREFERENCES = Registry(
    "preference",
    PreferenceKind,
    "specshield.preferences",
    {"lookahead": "specshield.lookahead.lookahead:PREFERENCE"},
    field="shaping",
)


def check_shaping(name: str) -> None:
    """Raises InputError for a name that is neither "projection" nor a preference's."""
    names = [PROJECTION, *PREFERENCES.names()]
    if name not in names:
        raise InputError("unknown shaping", path="shaping", got=name, expected=f"one of {', '.join(names)}")


def prepare(name: str, task: Task, proposers: Sequence[Proposer], pose: Sequence[float]) -> Preference:
    """The preference of that name for a task, ready for its first step: its kernels are compiled.

    pose: any pose (x, y, theta) of the robot's. Raises what `PreferenceKind.prepare` raises, and says of a
    FragmentError that the shaping is at fault.
    """
    try:
        preference = PREFERENCES.get(name).prepare(task, proposers)
    except FragmentError as error:
        told = f"{name!r} cannot be had for this formula: {error.message}"
        expected = "'projection', or a formula that 'reachability' takes"
        raise FragmentError(told, path="shaping", got=name, expected=expected) from None
    actions = len(task.robot.actions)
    signals = {signal: np.array([value]) for signal, value in task.signals.items()}
    even = np.full(actions, -math.log(actions))
    nothing = np.zeros(actions, bool)  # feasible: so that a preference which waits for force is run whole
    preference.step(preference.begin(), np.array([pose], dtype=np.float64), signals, even, nothing)
    return preference
