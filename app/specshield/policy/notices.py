"""The warnings about a new policy: that no start keeps its rule, that it misses starts, that a part of the
rule asks for nothing, or that turns of its robot look like degrees.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from specshield.arrays import Floats
from specshield.caution.signals import any_signal
from specshield.caution.worst import worst_signals
from specshield.episode import start
from specshield.errors import InfeasibleStart, MapError, SampleError
from specshield.policy.dqn.environment import free_poses
from specshield.reasons.bound import contradiction, idle
from specshield.reasons.relaxation import way
from specshield.robot import Robot
from specshield.shield.decision import Config, Shield, make_shield
from specshield.shield.proposal import Proposer

STARTS = 16  # poses that a new policy is tried from. By hand, so that all of this takes a second or two.
MOST_SEARCHED = 4  # of those from which it has no future


def notices(policy: Proposer) -> tuple[str, ...]:
    """One sentence each. The starts are drawn from free space, the same each time."""
    return (*odd_turns(policy.task.robot), *_of_rule(policy))


def odd_turns(robot: Robot) -> Iterator[str]:
    """What looks odd about the robot's turns, one sentence each."""
    for name, turn in ((action.name, action.rotate) for action in robot.actions):
        if abs(turn) > math.pi:
            meant = f"{turn:g} degrees would be {math.radians(turn):.4g} radians"
            yield f"the action {name!r} turns by {turn:g} radians, which is more than half a turn; {meant}"


def _of_rule(policy: Proposer) -> tuple[str, ...]:
    task, shield = policy.task, make_shield([policy])
    why = contradiction(task, shield.body)
    if why is not None:
        return (f"no start satisfies this formula: {why}",)
    try:
        poses = free_poses(task, shield.body, STARTS, np.random.default_rng(0))
    except MapError:
        return (f"the robot fits nowhere on this map: its footprint has a radius of {task.robot.radius:g} m",)
    refused = [pose for pose in poses if not may_begin(shield, pose.tolist())]
    missed = sum(way(shield, pose[None], {}) is not None for pose in refused[:MOST_SEARCHED])
    if missed:
        tried = min(len(refused), MOST_SEARCHED)
        finer = "it hardly sees some predicate of the formula; a smaller options.pitch or "
        coarse = hasattr(getattr(policy, "settings", None), "pitch")  # a network has no lattice
        return (
            f"the policy found no future from {len(refused)} of {STARTS} random starts, and a search found "
            f"one from {missed} of {tried} of these: {finer * coarse}another method may find more",
        )
    if len(refused) == STARTS:
        return (f"no future that satisfies the formula was found from any of {STARTS} random starts",)
    of_signals = _of_signals(shield, poses, STARTS - len(refused)) if task.signals else ()
    return (*dict.fromkeys(idle(task, shield.body)), *of_signals)


def _of_signals(shield: Shield, poses: Floats, silent: int) -> tuple[str, ...]:
    """Warnings about a rule that signals may make harder to keep. silent: from how many starts the rule can
    be kept if the signals stay as they are.
    """
    if worst_signals(shield.task, shield.task.formula) is None:
        return (
            "nothing can be said of signals that change: the formula compares signals with the pose, or "
            "asks for things that no values of the signals ask for together; the rule is kept if they stay "
            "as they are",
        )
    asked = replace(shield, config=Config(any_signal=True))
    kept = sum(any_signal(asked, pose[None]) is True for pose in poses)
    if kept == silent:
        return ()
    return (
        f"of {STARTS} random starts, the rule can be kept from {kept} whatever the signals do, and from "
        f"{silent} if they stay as they are; feasible_start takes them to stay",
    )


def may_begin(shield: Shield, pose: Sequence[float]) -> bool:
    """Whether a session may begin at a pose (x, y, theta). Raises PoseError for one that is not free."""
    try:
        start(shield, pose)
    except (InfeasibleStart, SampleError):
        return False
    return True
