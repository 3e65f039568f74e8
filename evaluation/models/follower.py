"""A model that gets its way at the start and remembers only its recent steps, so that a long detour fails it.

Its way is the shortest along free space from where it starts. It knows how far along it is as long as it left
it no more than MEMORY steps ago. After that it is lost, for good: then it picks waypoints in what it sees, as
the rover does, until it sees its target.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from evaluation.models.rover import Rover
from specshield.arrays import Floats
from specshield.sim.cases import Case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import Pose, SimulatedRobot, waypoints

MEMORY = 20  # steps
BESIDE = 0.7  # [m] from its way it is still on it
ALONG = 0.5  # [m] ahead on its way is where it drives to
STEP = 0.05  # [m] between the points of a way


class Follower:
    def __init__(self, case: Case) -> None:
        self._case = case
        self._driver, self._rover = GoalSeeker(case.task.robot), Rover(case.task.robot)
        self.reset(np.random.default_rng(0))

    def reset(self, random: np.random.Generator) -> None:
        self._driver.reset(random)
        self._rover.reset(random)
        self._track: Track | None = None

    def logits(self, robot: SimulatedRobot) -> Floats:
        if self._track is None:
            self._track = Track(route(self._case, robot.pose))
        self._track.follow(robot.pose)
        if self._track.lost:
            return self._rover.logits(robot)
        x, y, theta = robot.pose
        left, ahead = self._track.left, self._track.ahead
        bearing = math.remainder(math.atan2(ahead[1] - y, ahead[0] - x) - theta, 2.0 * math.pi)
        return self._driver.react(replace(robot.observe(), distance=left, bearing=bearing))


class Track:
    """How far a robot is along a way [n, 2], and whether it has been off it for more than MEMORY steps."""

    def __init__(self, way: Floats) -> None:
        self._way, self._at, self._off, self.lost = way, 0, 0, False

    def follow(self, pose: Pose) -> None:
        away = np.hypot(*(self._way[self._at :] - pose[:2]).T)
        soon = away[: int(2.0 * MEMORY * 0.2 / STEP)]  # no farther on than it can have driven
        on_it = float(soon.min()) < BESIDE
        if on_it:
            self._at += int(soon.argmin())
        self._off = 0 if on_it else self._off + 1
        self.lost |= self._off > MEMORY

    @property
    def ahead(self) -> Floats:
        point: Floats = self._way[min(self._at + round(ALONG / STEP), len(self._way) - 1)]
        return point

    @property
    def left(self) -> float:
        """[m] to the end of the way."""
        return (len(self._way) - 1 - self._at) * STEP


def route(case: Case, pose: Pose) -> Floats:
    """Points STEP apart on the way that keeps off the walls, from a pose to the case's target, [n, 2]."""
    ends, corners = waypoints(case), [pose[:2]]
    while math.dist(corners[-1], case.target) > ALONG and len(corners) < 500:
        x, y = ends[case.cell(corners[-1])].tolist()
        if math.dist((x, y), corners[-1]) < STEP:
            break
        corners.append((x, y))
    corners.append(case.target)
    legs = [
        np.linspace(one, other, max(round(math.dist(one, other) / STEP), 1), endpoint=False)
        for one, other in pairwise(corners)
    ]
    return np.concatenate([*legs, np.array([case.target])])


def lost(case: Case, poses: list[list[float]]) -> bool:
    """Whether a model that drove so, from the first pose on, has lost its way."""
    track = Track(route(case, (poses[0][0], poses[0][1], poses[0][2])))
    for x, y, theta in poses:
        track.follow((x, y, theta))
    return track.lost
