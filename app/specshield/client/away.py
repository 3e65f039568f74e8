"""Follows the certified continuation while the service cannot answer."""

from __future__ import annotations

import cmath
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from specshield.client.models import Decision, Pose
from specshield.client.wiring import Move, between
from specshield.errors import (
    HistoryConflict,
    InputError,
    LimitReached,
    SpecshieldError,
    StepConflict,
    TransportError,
)

OnFailure = Literal["raise", "witness", "stop"]
NEAR = 0.05  # [m] that a robot may be off the foreseen pose, beyond the session's margin; chosen by hand
TURNED = 0.1  # [rad] that its heading may be off; chosen by hand
FIRST_PAUSE = 0.25  # [s] before an absent service is asked again, doubled each time; chosen by hand
LONGEST_PAUSE = 4.0  # [s]; chosen by hand: so long a robot may go alone though the service is back


def on_failure_value(value: str) -> OnFailure:
    """`value`, if it is one of the three words. Raises InputError."""
    if value not in ("raise", "witness", "stop"):
        raise InputError(
            "unknown on_failure", path="on_failure", got=value, expected="'raise', 'witness' or 'stop'"
        )
    return value  # type: ignore[return-value]


def is_away(error: SpecshieldError) -> bool:
    """Whether the error means that the service cannot answer now, rather than that the request is wrong."""
    status = error.details.get("status")
    return isinstance(error, TransportError | LimitReached) or (isinstance(status, int) and status >= 500)


def is_taken(error: SpecshieldError, t: int) -> bool:
    """Whether the error says that the service has step t already, with another pose or other logits."""
    stored = isinstance(error, HistoryConflict) and error.details.get("t") == t
    return stored or (isinstance(error, StepConflict) and error.path != "main_task_done")


@dataclass
class Circuit:
    """Says when to ask the service: after a failure only after a pause, which grows up to LONGEST_PAUSE."""

    clock: Callable[[], float] = time.monotonic
    pause: float = 0.0
    again: float = -math.inf

    @property
    def open(self) -> bool:
        """Whether the last request was not answered."""
        return self.pause > 0.0

    @property
    def due(self) -> bool:
        return self.clock() >= self.again

    def failed(self) -> None:
        self.pause = min(2.0 * self.pause or FIRST_PAUSE, LONGEST_PAUSE)
        self.again = self.clock() + self.pause

    def answered(self) -> None:
        self.pause, self.again = 0.0, -math.inf


class Branch(NamedTuple):
    """One way to go on: the foreseen pose x_t, and the actions from step t to the rule's last step."""

    pose: Pose
    plan: tuple[int, ...]


# A new process reads back the answers of so many steps: enough to see how far each motion leads where nothing
# is in its way. Chosen by hand.
RECALLED = 100


@dataclass
class Continuation:
    """The latest certified continuation, followed from pose to pose without a map.

    The motion of an action is taken from the service's answers: the longest displacement in the robot's frame
    that `next_poses` ever showed, since a wall in the way makes it shorter. So a continuation that runs into
    something is given up there, and the robot is told to stop.
    """

    margin: float = 0.0  # [m]
    branches: tuple[Branch, ...] = ()
    motions: dict[int, Move] = field(default_factory=dict)

    def learn(self, decision: Decision, pose: Pose) -> None:
        """Takes over the ways in the answer at `pose`: with `witnesses` one for each action."""
        for action, after in enumerate(decision.next_poses):
            motion = between(pose, after)
            if _length(motion) >= _length(self.motions.get(action, (0j, 0.0))):
                self.motions[action] = motion
        ways = {decision.execute: decision.witness}
        if decision.witnesses:
            ways |= dict(enumerate(decision.witnesses))
        self.branches = tuple(
            Branch(decision.next_poses[action], plan) for action, plan in ways.items() if plan is not None
        )

    def at(self, pose: Pose) -> Branch | str:
        """The branch that goes on from `pose`, or a text that says why there is none."""
        if not self.branches:
            return "the service has certified no continuation"
        branch = min(self.branches, key=lambda branch: _length(between(branch.pose, pose)))
        off, turn = between(branch.pose, pose)
        if abs(off) > NEAR + self.margin or abs(turn) > TURNED:
            return (
                f"the robot is {abs(off):.2f} m and {abs(turn):.2f} rad from where the certified "
                "continuation leads"
            )
        ended = "the certified continuation has ended: the rule's last step is reached"
        return branch if branch.plan else ended

    def follow(self, pose: Pose) -> None:
        """Moves the branches on by the action that is run from `pose`; none are left if there is no way."""
        way = self.at(pose)
        self.branches = ()
        if isinstance(way, Branch) and way.plan[0] in self.motions:
            self.branches = (Branch(_moved(way.pose, self.motions[way.plan[0]]), way.plan[1:]),)


def _moved(pose: Pose, motion: Move) -> Pose:
    end = complex(pose[0], pose[1]) + motion[0] * cmath.exp(1j * pose[2])
    return end.real, end.imag, math.remainder(pose[2] + motion[1], math.tau)


def _length(motion: Move) -> float:
    return abs(motion[0]) + abs(motion[1])
