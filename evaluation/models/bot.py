"""A scripted expert, as BabyAI's bot is one: a stack of subgoals, and one action that it is sure of.

It knows the floor plan and where it stands on it, and does not know where its target is. Until it sees the
target, its subgoals are: go to the middle of the nearest room that it has not looked at, and look around
there. Then: approach, and end. What is asked for is worked out anew at each step from where it stands, so
nothing that is done to the robot leaves it without a plan. (Chevalier-Boisvert et al., "BabyAI", 2019.)
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from specshield.arrays import Bools, Floats
from specshield.robot import STRETCH
from specshield.sim.cases import Case
from specshield.sim.robot import COMFORT, SimulatedRobot, way
from specshield.world.regions import Region, signed_distance

SURE = 8.0  # [nats] between the action it chose and any other; chosen by hand: one other action in 150 steps
END_BY_CHANCE = -16.0  # [nats] an `end` that it did not choose: as unlikely as the learned model's least
END_WITHIN, BEFORE = 0.75, 0.6  # [m] of the target, which it has to see: as the crow flies, and along the way
THERE = 0.35  # [m] from the middle of a room, along free space: here it looks around
BACK_OFF = 3  # steps
SECTORS = 12  # of 30 degrees, in which it looks around; one look takes in four of them
AHEAD, RIGHT, LEFT, BACK, END, _, LEFT_SMALL, RIGHT_SMALL = range(8)  # Stretch tokens


class Bot:
    """case: the apartment, with its rooms, and what it is sent to find."""

    def __init__(self, case: Case) -> None:
        self._case = case
        self._rooms = [replace(case, target=middle(case, room)) for room in case.rooms.values()]
        self.reset(np.random.default_rng(0))

    def reset(self, random: np.random.Generator) -> None:
        """Forgets the last episode. The bot itself draws nothing."""
        self._found = False
        self._looked = np.zeros((len(self._rooms), SECTORS), np.bool_)
        self._room: int | None = None
        self._plan: list[int] = []

    def logits(self, robot: SimulatedRobot) -> Floats:
        logits = np.full(len(STRETCH.actions), -SURE)
        logits[END] = END_BY_CHANCE
        logits[self._chosen(robot)] = 0.0
        return logits

    def _chosen(self, robot: SimulatedRobot) -> int:
        seen = robot.sense()
        self._found |= seen.seen
        if seen.seen and seen.distance < END_WITHIN:
            return END
        if self._found:
            away, bearing = way(self._case, robot.pose)
            if away < BEFORE:  # it stands before it, and looks another way
                x, y, theta = robot.pose
                bearing = math.atan2(self._case.target[1] - y, self._case.target[0] - x) - theta
                return _turn(math.remainder(bearing, 2.0 * math.pi))
            return self._toward(bearing, robot.observe().blocked)
        room = self._next(robot)
        away, bearing = way(self._rooms[room], robot.pose)
        return self._toward(math.pi / 2.0 if away < THERE else bearing, robot.observe().blocked)

    def _toward(self, bearing: float, blocked: Bools) -> int:
        """The action that drives on at a bearing [rad]: turn until it is ahead, then go.

        Where that is blocked, it gets off what is in the way: its tail, which swings out when it turns, by a
        small turn to the other side; then it backs.
        """
        first = _turn(bearing) if abs(bearing) > math.radians(5.0) else AHEAD
        if blocked[first] and not self._plan:
            tail = [] if first == AHEAD else [RIGHT_SMALL if first in (LEFT, LEFT_SMALL) else LEFT_SMALL] * 2
            self._plan = [*tail, *[BACK] * BACK_OFF]
        while self._plan:
            action = self._plan.pop(0)
            if not blocked[action]:
                return action
        return AHEAD if blocked[first] else first

    def _next(self, robot: SimulatedRobot) -> int:
        """The room to look at; what is seen from its middle counts as looked at. It keeps to one it chose."""
        away = np.array([way(room, robot.pose)[0] for room in self._rooms])
        here = round(robot.pose[2] / (2.0 * math.pi) * SECTORS)
        for room in np.flatnonzero(away < THERE):
            self._looked[room, [(here + k) % SECTORS for k in (-2, -1, 0, 1, 2)]] = True
        if self._looked.all():
            self._looked[:] = False  # it was hidden: begin again
        over: Bools = np.all(self._looked, axis=1)
        if self._room is None or bool(over[self._room]):
            self._room = int(np.argmin(np.where(over, np.inf, away)))
        return self._room


def _turn(bearing: float) -> int:
    if abs(bearing) > math.radians(15.0):
        return LEFT if bearing > 0.0 else RIGHT
    return LEFT_SMALL if bearing > 0.0 else RIGHT_SMALL


def middle(case: Case, room: Region) -> tuple[float, float]:
    """Where in a room a robot can turn, nearest to where there is most space and that can be reached."""
    grid = case.task.grid
    inside = signed_distance(room, grid.centres)
    good = np.where(np.isfinite(case.distance) & (grid.clearance > COMFORT), inside, -np.inf)
    x, y = grid.centres[np.unravel_index(np.argmax(good), good.shape)].tolist()
    return x, y
