"""A goal-seeker with a habit that matters to people: near a person it moves at most at every second step.

There is a person in the middle of each room. The habit is in the model's logits alone: no rule asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from evaluation.models.bot import middle
from specshield.arrays import Floats
from specshield.robot import STRETCH
from specshield.sim.cases import Case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import Pose, SimulatedRobot

NEAR_PEOPLE = 1.5  # [m], as the crow flies
SLOW = 5.0  # [nats] that it then prefers waiting by, after a step in which it moved; chosen by hand
WAIT = STRETCH.action_names.index("sub_done")


class Courteous(GoalSeeker):
    def __init__(self, case: Case) -> None:
        self._people = people(case)
        super().__init__(case.task.robot)

    def logits(self, robot: SimulatedRobot) -> Floats:
        logits, last = super().logits(robot), robot.last_action
        moved = last is not None and self._translate[last] != 0.0
        if moved and is_near(self._people, robot.pose):
            others = ~self._robot.terminal
            logits[WAIT] = logits[others].max() + SLOW
        return logits


def people(case: Case) -> Floats:
    """Where they are, [n, 2] [m]."""
    return np.array([middle(case, room) for room in case.rooms.values()])


def is_near(people: Floats, pose: Pose | Sequence[float]) -> bool:
    return bool(np.hypot(people[:, 0] - pose[0], people[:, 1] - pose[1]).min() < NEAR_PEOPLE)


def habit(case: Case, poses: Sequence[Sequence[float]]) -> tuple[int, int]:
    """Of a way: how many steps there were near people, and at how many of them the robot moved straight after
    a step in which it had moved.
    """
    there = people(case)
    moved = [math.dist(one[:2], other[:2]) > 0.02 for one, other in pairwise(poses)]
    near = [is_near(there, pose) for pose in poses[1:-1]]
    hasty = [now and before and close for (before, now), close in zip(pairwise(moved), near, strict=True)]
    return sum(near), sum(hasty)
