"""Goal-seekers that mislead: where a Jumper, a Decoyed or a Drifter is going cannot be known from its logits.

They show what look-ahead (specshield.lookahead) costs where it takes a model for what it is not.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import replace

import numpy as np

from specshield.arrays import Floats
from specshield.sim.cases import Case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import COMFORT, NEAR, Observation, SimulatedRobot, way


class Errant(GoalSeeker):
    """A goal-seeker that goes to other places before it goes to its target, and ends at none of them."""

    PLACES = 8

    def __init__(self, case: Case) -> None:
        self._elsewhere = elsewhere(case, self.PLACES)
        super().__init__(case.task.robot)

    @abstractmethod
    def errand(self, robot: SimulatedRobot) -> Case | None:
        """The case with the place as its target where it goes at this step; None: to its own target."""

    def logits(self, robot: SimulatedRobot) -> Floats:
        seen, errand = robot.observe(), self.errand(robot)
        if errand is not None:
            seen = replace(seen, distance=math.inf, bearing=way(errand, robot.pose)[1])
        return self.react(seen)

    def _any(self) -> Case:
        return self._elsewhere[int(self._random.integers(self.PLACES))]


class Jumper(Errant):
    """A goal-seeker that changes its mind: at random steps, wherever it is, it sets out for another place.

    After some of these jumps the place is its target, and it keeps to that one. When it jumps, and where to,
    does not depend on how it is steered.
    """

    JUMP = 0.05  # chance of a jump at a step
    HOME = 0.2  # share of the jumps that go to the target

    def reset(self, random: np.random.Generator) -> None:
        super().reset(random)
        self._errand: Case | None = self._any()

    def errand(self, robot: SimulatedRobot) -> Case | None:
        if self._errand is not None and self._random.random() < self.JUMP:
            self._errand = None if self._random.random() < self.HOME else self._any()
        return self._errand


class Decoyed(Errant):
    """A goal-seeker with a wrong target: it goes there first, stays near it for some tens of steps without
    ending, and then turns to the right one.
    """

    STAY = 30.0  # mean number of steps that it stays near the wrong target

    def reset(self, random: np.random.Generator) -> None:
        super().reset(random)
        self._decoy = self._any()
        self._left = int(random.geometric(1.0 / self.STAY))  # steps that it will still stay

    def errand(self, robot: SimulatedRobot) -> Case | None:
        if self._left > 0 and way(self._decoy, robot.pose)[0] <= NEAR:
            self._left -= 1
        return self._decoy if self._left > 0 else None


class Drifter(GoalSeeker):
    """Goes nowhere for a long time, and then seeks its target.

    While it drifts it never ends; its preferences for actions change slowly, without regard to the way, save
    for actions that are blocked. For how long it drifts does not depend on how it is steered.
    """

    WHILE = 120.0  # mean number of steps that it drifts
    LIKING = 2.0  # logits, standard deviation of its preferences
    LASTING = 0.97  # share of the preferences that stays from one step to the next
    BLOCKED = -2.5  # logits

    def reset(self, random: np.random.Generator) -> None:
        super().reset(random)
        self._left = int(random.geometric(1.0 / self.WHILE))  # steps that it will still drift

    def react(self, observation: Observation) -> Floats:
        if self._left == 0:
            return super().react(observation)
        self._left -= 1
        self._shake(self.LASTING)
        logits = self.LIKING * self._noise
        logits[observation.blocked] += self.BLOCKED
        logits[self._idle] += self.IDLE
        logits[self._robot.terminal] = self.END_FAR
        return logits


def elsewhere(case: Case, places: int) -> list[Case]:
    """The case with its target at other places instead, at which the robot can turn freely.

    Each place is the one that is farthest, along free space, from the target and from the places before it.
    """
    grid = case.task.grid
    nearest = np.where(grid.clearance > COMFORT, case.distance, -np.inf)
    nearest[np.isinf(nearest)] = -1.0  # walls, and what cannot be reached
    found: list[Case] = []
    for _ in range(places):
        x, y = grid.centres[np.unravel_index(np.argmax(nearest), nearest.shape)].tolist()
        found.append(replace(case, target=(x, y)))
        nearest = np.minimum(nearest, found[-1].distance)
    return found
