"""Keeps policies that draw samples of continuous actions inside a rule.

A shield chooses among a robot's actions. A policy such as pi0 draws samples instead. So each sample counts as
the action whose motion is nearest, and the shares of the samples are the model's distribution. The shield
draws an action, and one of its samples is run as it came from the model.

Limits: a policy that returns the same sample each time has only one action, and if that is forbidden, the
certified continuation is run instead. Only the first row of a chunk is judged and run. A sample differs from
its nearest action, which the session sees as a residual: `uncertainty="learned"` keeps a margin for it, and
the guarantee is no better than that.
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
    """The interface that is needed here of a LocalSession or a session of the SDK."""

    main_task_done: bool

    def step(self, pose: Any, logits: Any = None, *, main_task_done: bool | None = None) -> Any: ...


class Chosen(NamedTuple):
    """sample: the index of the sample to run. None: no sample is allowed, and `action` is run, with
    everything else as in the sample `like`. action: None if the service is away and the robot has to stand.
    """

    action: int | None
    sample: int | None
    like: int
    decision: Decision | LocalDecision


@dataclass(frozen=True)
class SampleShield:
    """Chooses among samples.

    robot: the robot of the session's policy. pose_of: returns (x, y, theta) in the map's frame for an
    observation. command_of: returns how far a sample's first row moves [m] and turns [rad] the robot.
    """

    session: Session
    robot: Robot
    pose_of: Callable[[Any], Pose]
    command_of: Callable[[Floats], tuple[float, float]]

    def choose(self, rows: Sequence[Floats], observation: Any) -> Chosen:
        """Makes one decision of the session. rows: the first row of each sample; rows whose command is not
        finite are left out. Raises InputError if none is left.
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

    row_of: returns a row of actions [D] that moves the robot by `translate` [m] and `rotate` [rad] and is
    else like the given row; it is run if no sample is allowed. samples: how many are drawn for each decision.
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
        """Resets the policy. A session is for one episode: a new episode needs a new wrapper."""
        self._policy.reset()

    def _instead(self, chosen: Chosen, row: Floats) -> Floats:
        """The row that is run if no sample is allowed."""
        if chosen.action is None:
            return self._row_of(0.0, 0.0, row)
        action = self._shield.robot.actions[chosen.action]
        return self._row_of(action.translate, action.rotate, row)


def nearest_action(robot: Robot, translate: float, rotate: float) -> int:
    """The action whose motion is nearest to [m], [rad]; a turn counts as its arc at the footprint's edge."""
    motions = np.array(robot.motions) - (translate, rotate)
    gap = np.hypot(motions[:, 0], robot.radius * motions[:, 1])
    return int(robot.representative[int(np.argmin(gap))])
