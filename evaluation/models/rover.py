"""A model that samples waypoints: it picks a point in what its scanner sees, drives straight there, and on.

It has no floor plan and no way to its target. It prefers points that are far from where it has been, and once
it has seen its target the waypoint is the target. Its distribution is a Gaussian over the change of heading,
read off at the actions, as that of a policy that predicts a direction and an uncertainty.
"""

from __future__ import annotations

import math

import numpy as np

from specshield.arrays import Floats
from specshield.robot import Robot
from specshield.sim.model import softmax
from specshield.sim.robot import SimulatedRobot
from specshield.sim.senses import RAYS, Senses

SPREAD = math.radians(10.0)  # standard deviation of the heading it goes for
FARTHEST, NEAREST = 3.0, 0.6  # [m] of a waypoint
BEFORE_WALL = 0.5  # [m] that a waypoint keeps off what the ray meets
POINTS = 24  # that are sampled for one waypoint
WIDE = 1  # rays to each side that have to be as clear, so that it does not graze what it passes
NOVELTY = 3.0  # logits that a point loses for each e-fold of times that it has been about there
NEW = 1.5  # [m]
THERE = 0.3  # [m] from a waypoint
PATIENCE = 40  # steps after which it gives a waypoint up
END_WITHIN = 0.7  # [m] of the target, while it sees it
MOVE = 2.0  # logits for going ahead beside turning by nothing
IDLE, BLOCKED, BACKWARDS, AWAY = -6.0, -6.0, -3.0, 8.0  # logits; AWAY: backwards, while it backs off
BACK_OFF = 4  # steps, once what it would do most likely is blocked
END_NEAR, END_FAR = 2.5, -12.0  # logits of `end`
FLOOR = 16.0  # [nats] below the best logit is as unlikely as an action gets

Point = tuple[float, float]


class Rover:
    """robot: with its actions. It keeps count of where it is itself: its waypoints are points on a map."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._translate = np.array([a.translate for a in robot.actions])
        self._rotate = np.array([a.rotate for a in robot.actions])
        self._idle = (self._translate == 0.0) & (self._rotate == 0.0) & ~robot.terminal
        self.reset(np.random.default_rng(0))

    def reset(self, random: np.random.Generator) -> None:
        self._random = random
        self._been: list[Point] = []
        self._waypoint: Point | None = None
        self._target: Point | None = None
        self._left, self._backing = 0, 0

    def logits(self, robot: SimulatedRobot) -> Floats:
        x, y, theta = robot.pose
        seen, blocked = robot.sense(), robot.observe().blocked
        if not self._been or math.dist(self._been[-1], (x, y)) > 0.5:
            self._been.append((x, y))
        if seen.seen:
            self._target = _at(robot.pose, seen.bearing, seen.distance)
        aim = self._aim(robot, seen)
        bearing = math.remainder(math.atan2(aim[1] - y, aim[0] - x) - theta, 2.0 * math.pi)
        largest = float(np.abs(self._rotate).max())
        wanted = min(max(bearing, -largest), largest)
        logits: Floats = -0.5 * ((self._rotate - wanted) / SPREAD) ** 2
        logits[self._translate > 0.0] += MOVE
        logits[self._translate < 0.0] += BACKWARDS if self._backing == 0 else AWAY
        logits[self._idle] += IDLE
        self._backing = max(self._backing - 1, 0)
        if blocked[np.argmax(logits)] and self._backing == 0:
            self._backing, self._left = BACK_OFF, BACK_OFF  # then it picks another waypoint
        logits[blocked] += BLOCKED
        near = seen.seen and seen.distance < END_WITHIN
        logits[self._robot.terminal] = logits.max() + (END_NEAR if near else END_FAR)
        floored: Floats = np.maximum(logits, logits.max() - FLOOR)
        return floored

    def _aim(self, robot: SimulatedRobot, seen: Senses) -> Point:
        """The waypoint to drive to now."""
        self._left -= 1
        here = robot.pose[:2]
        if seen.seen and self._target is not None:
            self._waypoint, self._left = self._target, PATIENCE
        elif self._waypoint is None or self._left <= 0 or math.dist(here, self._waypoint) < THERE:
            self._waypoint, self._left = self._sampled(robot.pose, seen.ranges), PATIENCE
        return self._waypoint

    def _sampled(self, pose: tuple[float, float, float], ranges: Floats) -> Point:
        """One of POINTS points in sight: rather one that is new to it, and nearer a target it has seen."""
        clear = np.min([np.roll(ranges, k) for k in range(-WIDE, WIDE + 1)], axis=0)
        rays = self._random.integers(RAYS, size=POINTS)
        reach = np.minimum(clear[rays] - BEFORE_WALL, FARTHEST)
        far = NEAREST + self._random.random(POINTS) * np.maximum(reach - NEAREST, 0.0)
        points = np.array([_at(pose, 2.0 * math.pi * k / RAYS, d) for k, d in zip(rays, far, strict=True)])
        away = np.hypot(*(points[:, None] - np.array(self._been)).transpose(2, 0, 1))
        wish = -NOVELTY * np.log(1.0 + np.exp(-((away / NEW) ** 2)).sum(axis=1))
        if self._target is not None:
            wish -= np.hypot(*(points - self._target).T)
        x, y = points[self._random.choice(POINTS, p=softmax(np.where(reach > NEAREST, wish, -50.0)))]
        return float(x), float(y)


def _at(pose: tuple[float, float, float], bearing: float, distance: float) -> Point:
    x, y, theta = pose
    return x + distance * math.cos(theta + bearing), y + distance * math.sin(theta + bearing)
