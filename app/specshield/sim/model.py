"""The interface of foundation models in the simulation, and a simple stand-in, which knows no rule."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from specshield.arrays import Floats
from specshield.robot import Robot
from specshield.sim.robot import Observation, SimulatedRobot


class FoundationModel(Protocol):
    """A model with a memory: it takes what the robot senses and returns logits."""

    def reset(self, random: np.random.Generator) -> None:
        """Forgets the last episode. All randomness of the next one comes from `random`."""
        ...

    def logits(self, robot: SimulatedRobot) -> Floats:
        """Finite logits, shape (A,). Called once a step; reads the robot's senses, never its pose."""
        ...


class GoalSeeker:
    """Prefers actions that bring it nearer to its target, hesitates, and ends near the target.

    A logit is the number of steps that an action saves, times SHARPNESS, plus noise that drifts from step to
    step (as a learned model's errors do) and a preference for the last executed action. The constants were
    chosen by hand, so that the entropy of its distributions is 0.5 to 2 nats (tests/sim/test_model.py).
    """

    SHARPNESS = 2.5  # logits for each saved step
    NOISE = 0.6  # logits, standard deviation
    DRIFT = 0.5  # share of the noise that remains from one step to the next
    HABIT = 0.5  # logits for the last executed action
    IDLE = -4.0  # logits for tokens that do not move the base
    END_WITHIN = 0.7  # [m] from the target
    END_NEAR, END_FAR, END_SLOPE = 2.5, -9.0, 30.0  # logits of `end`, and their slope in between [1/m]

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
        """Makes the noise of the next step: the share `kept` of it is the last noise, and its variance 1."""
        fresh = self._random.normal(size=len(self._noise))
        self._noise = kept * self._noise + math.sqrt(1.0 - kept**2) * fresh

    def _saved(self, observation: Observation) -> Floats:
        """The steps that each action saves, shape (A,): 1 for a stride or the largest turn to the target."""
        bearing = observation.bearing
        nearer = self._translate / self._stride * math.cos(bearing)
        after = np.abs(np.remainder(bearing - self._rotate + math.pi, 2.0 * math.pi) - math.pi)
        saved: Floats = nearer + (abs(bearing) - after) / self._turn
        return np.where(observation.blocked, -1.0, saved)


def softmax(logits: Floats) -> Floats:
    weights = np.exp(logits - logits.max())
    return np.asarray(weights / weights.sum())
