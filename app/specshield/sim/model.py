"""The foundation model as the simulation sees it, and stand-ins for it that know no rule.

GoalSeeker is the plain one. Where Jumper, Decoyed and Drifter are going cannot be known from their logits:
they show what look-ahead (shield/lookahead.py) costs where it takes a model for what it is not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from specshield.errors import NotFound
from specshield.robot import Robot
from specshield.sim.cases import Case
from specshield.sim.learned.model import load_learned
from specshield.sim.robot import COMFORT, NEAR, Observation, SimulatedRobot

Floats = NDArray[np.float64]


class FoundationModel(Protocol):
    """A policy with a memory of its own: what the robot senses in, logits out."""

    def reset(self, random: np.random.Generator) -> None:
        """Forgets the last episode. All randomness of the next one comes from `random`."""
        ...

    def logits(self, robot: SimulatedRobot) -> Floats:
        """Finite logits, shape (A,). Called once a step; reads the robot's senses, never its pose."""
        ...


class GoalSeeker:
    """Stand-in for a learned model: prefers what brings it nearer, hesitates, and ends near the target.

    A logit is the steps an action saves, times `SHARPNESS`, plus noise that drifts over time (as a learned
    model's errors do) and a liking for what it did last.
    """

    SHARPNESS = 2.5
    NOISE = 0.6
    DRIFT = 0.5  # of the noise stays from one step to the next
    HABIT = 0.5
    IDLE = -4.0  # for tokens that leave the base where it is
    END_WITHIN = 0.7  # [m]
    END_NEAR, END_FAR, END_SLOPE = 2.5, -9.0, 30.0  # logits, and logits a metre between them

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._translate = np.array([a.translate for a in robot.actions])
        self._rotate = np.array([a.rotate for a in robot.actions])
        self._idle = (self._translate == 0.0) & (self._rotate == 0.0) & ~robot.terminal
        self._stride, self._turn = np.abs(self._translate).max(), np.abs(self._rotate).max()
        self.reset(np.random.default_rng(0))

    def reset(self, random: np.random.Generator) -> None:
        self._random = random
        self._noise = random.normal(size=len(self._robot.actions))

    def logits(self, robot: SimulatedRobot) -> Floats:
        return self.react(robot.observe())

    def react(self, observation: Observation) -> Floats:
        """Logits (A,) for one observation."""
        self._shake(self.DRIFT)
        logits = self.SHARPNESS * self._saved(observation) + self.NOISE * self._noise
        logits[self._idle] += self.IDLE
        if observation.last_action is not None:
            logits[observation.last_action] += self.HABIT
        beyond = max(observation.distance - self.END_WITHIN, 0.0)
        logits[self._robot.terminal] = max(self.END_NEAR - self.END_SLOPE * beyond, self.END_FAR)
        return logits

    def _shake(self, kept: float) -> None:
        """The noise of the next step, of which `kept` is that of the last; its variance stays 1."""
        fresh = self._random.normal(size=len(self._noise))
        self._noise = kept * self._noise + math.sqrt(1.0 - kept**2) * fresh

    def _saved(self, observation: Observation) -> Floats:
        """The steps each action saves, shape (A,): one for a stride nearer, or for the largest turn."""
        bearing = observation.bearing
        nearer = self._translate / self._stride * math.cos(bearing)
        after = np.abs(np.remainder(bearing - self._rotate + math.pi, 2.0 * math.pi) - math.pi)
        saved: Floats = nearer + (abs(bearing) - after) / self._turn
        return np.where(observation.blocked, -1.0, saved)


class Errant(GoalSeeker):
    """A goal-seeker that knows of other places than its target."""

    PLACES = 8

    def __init__(self, case: Case) -> None:
        self._elsewhere = elsewhere(case, self.PLACES)
        super().__init__(case.task.robot)

    def _any(self) -> Case:
        return self._elsewhere[int(self._random.integers(self.PLACES))]


class Jumper(Errant):
    """A goal-seeker that changes its mind: at random steps, wherever it is, it sets out for another place.

    In the end that is the target, which it keeps to. When it jumps, and where to, is the same however it is
    steered.
    """

    JUMP = 0.05  # a step
    HOME = 0.2  # of the jumps go to the target

    def reset(self, random: np.random.Generator) -> None:
        super().reset(random)
        self._errand: Case | None = self._any()

    def logits(self, robot: SimulatedRobot) -> Floats:
        if self._errand is not None and self._random.random() < self.JUMP:
            self._errand = None if self._random.random() < self.HOME else self._any()
        return self.react(_sent(robot, self._errand))


class Decoyed(Errant):
    """A goal-seeker with a wrong target: it goes there first, stays about it for some tens of steps without
    ending, and then turns to the right one.
    """

    STAY = 30.0  # steps near the decoy, in the mean

    def reset(self, random: np.random.Generator) -> None:
        super().reset(random)
        self._decoy = self._any()
        self._left = int(random.geometric(1.0 / self.STAY))  # steps near the decoy

    def logits(self, robot: SimulatedRobot) -> Floats:
        if self._left > 0 and robot.observe(self._decoy).distance <= NEAR:
            self._left -= 1
        return self.react(_sent(robot, self._decoy if self._left > 0 else None))


class Drifter(GoalSeeker):
    """Goes nowhere for a long time, and ends nowhere: its likings for actions drift, whatever the way, but
    for what is blocked. Then it seeks its target. For how long it drifts is the same however it is steered.
    """

    WHILE = 120.0  # steps that it drifts, in the mean
    LIKING = 2.0  # logits
    LASTING = 0.97  # of the likings stays from one step to the next
    BLOCKED = -2.5

    def reset(self, random: np.random.Generator) -> None:
        super().reset(random)
        self._left = int(random.geometric(1.0 / self.WHILE))  # steps to drift

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
    """The case with its target at other places instead, where the robot turns freely: each the farthest along
    free space from the target and those before it.
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


def _sent(robot: SimulatedRobot, errand: Case | None) -> Observation:
    """What the robot senses on an errand, where nothing is to be ended; None: on its own."""
    seen = robot.observe(errand)
    return seen if errand is None else replace(seen, distance=math.inf)


MODELS: dict[str, Callable[[Case], FoundationModel]] = {
    "decoyed": Decoyed,
    "drifter": lambda case: Drifter(case.task.robot),
    "goal-seeker": lambda case: GoalSeeker(case.task.robot),
    "jumper": Jumper,
    "learned": lambda case: load_learned(case.instruction),
}


def make_model(name: str, case: Case) -> FoundationModel:
    """A model of that name, told the case's instruction. Raises NotFound."""
    check_model(name)
    return MODELS[name](case)


def check_model(name: str) -> None:
    """Raises NotFound where no model has that name."""
    if name not in MODELS:
        raise NotFound(
            f"there is no model {name!r}", path="model", got=name, expected=f"one of {', '.join(MODELS)}"
        )


def softmax(logits: Floats) -> Floats:
    weights = np.exp(logits - logits.max())
    probabilities: Floats = weights / weights.sum()
    return probabilities
