"""A simulated robot: it moves exactly by the known dynamics, and senses its surroundings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from specshield.arrays import Bools, Floats
from specshield.lookahead.lattice import blocked_at
from specshield.policy.geodesic import downhill, falling, geodesic_distance
from specshield.robot.dynamics import step
from specshield.sim.cases import Case
from specshield.sim.senses import RAYS, Senses, scan, see

COMFORT = 0.32  # [m] clearance with which a Stretch can turn about its origin
LOOK_AHEAD = 10  # [cells] along the way, to the point whose bearing is sensed; chosen by hand
NEAR = 1.0  # [m] along free space within which an `end` has found the target

Pose = tuple[float, float, float]


@dataclass(frozen=True)
class Observation:
    """What the robot senses, without pose and map.

    distance: to the target along free space [m]. bearing: of the way there, from the heading [rad].
    blocked (A,): actions that something would stop. last_action: the last executed one, None at first.
    """

    distance: float
    bearing: float
    blocked: Bools
    last_action: int | None


class SimulatedRobot:
    """pose: (x, y, theta) [m, m, rad], map frame. last_action: the last executed one, None at first."""

    def __init__(self, case: Case, pose: Pose) -> None:
        self._case = case
        self.pose = pose
        self.last_action: int | None = None

    def execute(self, action: int) -> None:
        """Executes the action of this index; a terminal one moves nothing."""
        motion = self._case.task.robot.motion_of[action]
        if motion >= 0:
            self.pose = step(self._case.body, *self.pose, motion)
        self.last_action = action

    @property
    def at_target(self) -> bool:
        return bool(self._case.distance[self._case.cell(self.pose)] <= NEAR)

    def observe(self) -> Observation:
        distance, bearing = way(self._case, self.pose)
        return Observation(distance, bearing, self._blocked(), self.last_action)

    def sense(self) -> Senses:
        """What a robot without a map senses: its scanner, its camera, and the last action."""
        ranges = np.empty(RAYS)
        scan(self._case.body, *self.pose, ranges)
        return Senses(ranges, *see(self._case.body, *self.pose, *self._case.target), self.last_action)

    def _blocked(self) -> Bools:
        robot = self._case.task.robot
        return np.where(robot.terminal, False, blocked_at(self._case.body, *self.pose)[robot.motion_of])


def way(case: Case, pose: Pose) -> tuple[float, float]:
    """The distance to the case's target along free space [m], and the bearing of the way there from the
    robot's heading, in [-pi, pi].
    """
    cell, (x, y, theta) = case.cell(pose), pose
    ahead = waypoints(case)[cell] - (x, y)
    bearing = math.remainder(math.atan2(ahead[1], ahead[0]) - theta, 2.0 * math.pi)
    return float(case.distance[cell]), bearing


@lru_cache(maxsize=32)
def waypoints(case: Case) -> Floats:
    """For each cell, the point LOOK_AHEAD cells further along the way to the target [m], [height, width, 2].

    The way keeps away from the walls, so that the robot can turn on it; from a cell beside a wall it first
    leads away from the wall.
    """
    grid = case.task.grid
    free, comfortable = ~grid.occupied, grid.clearance > COMFORT
    goal = np.zeros_like(free)
    goal[case.cell(case.target)] = True
    onward = geodesic_distance(comfortable | goal, goal, grid.resolution)  # the target may be beside a wall
    if not np.isfinite(onward[comfortable]).any():  # or in a narrow place
        narrow = free & (case.distance <= case.distance[comfortable].min(initial=np.inf))
        onward = geodesic_distance(comfortable | narrow, goal, grid.resolution)
    off = geodesic_distance(free, np.isfinite(onward), grid.resolution)
    cell = downhill(falling(onward, off, grid.resolution), LOOK_AHEAD)
    return grid.centres.reshape(-1, 2)[cell].reshape(*free.shape, 2)
