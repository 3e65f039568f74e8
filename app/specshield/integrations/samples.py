"""Policies that answer with samples of continuous actions, inside a rule.

A shield chooses among a robot's actions. A policy such as pi0 offers samples instead: so each sample is read
as the action that is nearest to its motion, and how many samples each action has is the model's distribution.
The sample that is run is one of those of the action that the shield drew, as it came from the model.

What this cannot do: a policy that gives the same sample each time has one action, and where that is forbidden
the certified continuation is run instead; only the first row of a chunk is run and judged; between the
sample and its nearest action there is a gap, which the session sees as a residual (`uncertainty="learned"`
keeps a margin for it, and the guarantee is then no better than that).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from specshield.arrays import Floats
from specshield.client.models import Decision, LocalDecision, Pose
from specshield.errors import InputError
from specshield.robot import Robot


class Session(Protocol):
    """What a LocalSession and a session of the SDK have in common, as far as it is needed here."""

    main_task_done: bool

    def step(self, pose: Any, logits: Any = None, *, main_task_done: bool | None = None) -> Any: ...


class Chosen(NamedTuple):
    """sample: the index of the sample to run, None where none is allowed and the robot's `action` is run, in
    all else like the sample `like`. action: None where the service is away and the robot has to stand.
    """

    action: int | None
    sample: int | None
    like: int
    decision: Decision | LocalDecision


@dataclass(frozen=True)
class SampleShield:
    """Chooses among samples.

    robot: the one that the session's policy was made for. pose_of: (x, y, theta) in the map's frame, from an
    observation. command_of: how far a sample's first row moves [m] and turns [rad] the robot in one step.
    """

    session: Session
    robot: Robot
    pose_of: Callable[[Any], Pose]
    command_of: Callable[[Floats], tuple[float, float]]

    def choose(self, rows: Sequence[Floats], observation: Any) -> Chosen:
        """rows: the first row of each sample; those whose command is not finite are left out. One decision
        of the session. Raises InputError where none is left.
        """
        commands = np.array([self.command_of(row) for row in rows], np.float64).reshape(len(rows), 2)
        usable = np.flatnonzero(np.isfinite(commands).all(axis=1))
        if not len(usable):
            raise InputError("no finite samples", path="rows", got=len(rows), expected="at least one")
        meant = np.array([nearest_action(self.robot, *command) for command in commands[usable]])
        shares = np.bincount(meant, minlength=len(self.robot.actions)) / len(meant)
        with np.errstate(divide="ignore"):
            decision = self.session.step(
                self.pose_of(observation), np.log(shares), main_task_done=self.session.main_task_done
            )
        own = usable[meant == decision.execute]
        sample = int(own[0]) if len(own) else None
        return Chosen(decision.execute, sample, int(usable[0]) if sample is None else sample, decision)


class Sampled:
    """`policy` inside the rule of a shield's session.

    row_of: a row of actions [D] that makes the robot's motion of `translate` [m] and `rotate` [rad], like the
    given row in all else: what is run where no sample is allowed. samples: how often the policy is asked.
    """

    def __init__(
        self,
        policy: Any,
        shield: SampleShield,
        row_of: Callable[[float, float, Floats], Floats],
        samples: int = 8,
    ) -> None:
        self._policy, self._shield, self._row_of, self._samples = policy, shield, row_of, samples

    def reset(self) -> None:
        """Of the policy; a session is for one episode, so a new one takes a new wrapper."""
        self._policy.reset()

    def _instead(self, chosen: Chosen, row: Floats) -> Floats:
        """The row that is run where no sample is allowed."""
        if chosen.action is None:
            return self._row_of(0.0, 0.0, row)
        action = self._shield.robot.actions[chosen.action]
        return self._row_of(action.translate, action.rotate, row)


def nearest_action(robot: Robot, translate: float, rotate: float) -> int:
    """The action whose motion is nearest to [m], [rad]; a turn counts as its arc at the footprint's edge."""
    motions = np.array(robot.motions) - (translate, rotate)
    gap = np.hypot(motions[:, 0], robot.radius * motions[:, 1])
    return int(robot.representative[int(np.argmin(gap))])
