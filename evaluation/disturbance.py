"""Worlds that differ from what the shield was told.

    none        as told
    gaussian    every motion ends off by sigma 0.01 m along x and y and 0.5 degrees, as in SPOC's stochastic
                controller; standing still does not
    rough       the same, twice as much
    slip        one motion in twenty does nothing
    short       every motion goes nine tenths of its way, and turns as it should
    obstacle    something 0.3 m wide, on no map, stands on the way that was certified at the start
    shift       walls and furniture stand 0.05 m from where the map has them, along x or y
    collider    the robot's footprint lies 0.109 m behind its origin, as a Stretch's does, and the shield was
                told that it is centred

The rule is about true poses, and regions are where they are said to be. No disturbance takes a robot through
a wall: a pose that would collide is not taken, the robot is where f leads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from specshield.errors import NotFound
from specshield.robot.dynamics import Body, in_collision, wrap
from specshield.sim.cases import Case
from specshield.sim.robot import Pose
from specshield.task import Task
from specshield.world.occupancy import OccupancyGrid

DISTURBANCES = ("none", "gaussian", "rough", "slip", "short", "obstacle", "shift", "collider")
MOVED = ("obstacle", "shift")  # those in which the world itself is another
SIGMA_MOVE, SIGMA_TURN = 0.01, math.radians(0.5)  # [m], [rad]
ROUGHNESS = {"gaussian": 1.0, "rough": 2.0}  # times the two
SLIP = 0.05
SHORT = 0.1  # of a motion's way
OBSTACLE, SHIFT = 0.3, 0.05  # [m]
AWAY = 0.8  # [m] an obstacle keeps this far from the start and from the target
PASSABLE = 0.25  # [m] clearance of the space that an obstacle must not cut apart

Floats = NDArray[np.float64]


def check(name: str) -> str:
    """Raises NotFound for a disturbance that there is not."""
    if name not in DISTURBANCES:
        raise NotFound(
            f"there is no noise {name!r}", path="noise", got=name,
            expected=f"one of {', '.join(DISTURBANCES)}",
        )  # fmt: skip
    return name


def believed(name: str, task: Task) -> Task:
    """The task as the shield is told it."""
    return replace(task, robot=replace(task.robot, offset=(0.0, 0.0))) if name == "collider" else task


def world(name: str, case: Case, way: Callable[[], Floats], random: np.random.Generator) -> Case:
    """The case as it really is, in one episode. way: gives the poses certified at the start, [n, 3]."""
    if name == "shift":
        x, y, yaw = case.task.grid.origin
        dx, dy = ((SHIFT, 0.0), (-SHIFT, 0.0), (0.0, SHIFT), (0.0, -SHIFT))[random.integers(4)]
        return _with_grid(case, replace(case.task.grid, origin=(x + dx, y + dy, yaw)))
    if name == "obstacle":
        return _with_grid(case, _obstructed(case, way(), random))
    return case


def executed(name: str, body: Body, before: Pose, after: Pose, random: np.random.Generator) -> Pose:
    """Where the robot is after a motion that f takes from `before` to `after`."""
    noise, chance = random.normal(size=3), random.random()
    if after == before:
        return after
    if name == "slip" and chance < SLIP:
        return before
    if name == "short":
        x, y = (b + (1.0 - SHORT) * (a - b) for a, b in zip(after[:2], before[:2], strict=True))
        return x, y, after[2]
    if name in ROUGHNESS:
        move, turn = ROUGHNESS[name] * SIGMA_MOVE, ROUGHNESS[name] * SIGMA_TURN
        x, y, theta = after[0] + move * noise[0], after[1] + move * noise[1], wrap(after[2] + turn * noise[2])
        if not in_collision(body, x, y, theta):
            return float(x), float(y), float(theta)
    return after


def _with_grid(case: Case, grid: OccupancyGrid) -> Case:
    return replace(case, task=replace(case.task, grid=grid))


def _obstructed(case: Case, way: Floats, random: np.random.Generator) -> OccupancyGrid:
    """The grid with a box on the way, at the first place drawn that leaves all free space in one piece."""
    grid, half = case.task.grid, OBSTACLE / 2
    far = np.hypot(*(way[:, :2] - way[0, :2]).T) >= AWAY
    far &= np.hypot(*(way[:, :2] - case.target).T) >= AWAY
    pieces = label(grid.clearance > PASSABLE)[1]
    for x, y, _ in random.permutation(way[far]):
        box = np.all(np.abs(grid.centres - (x, y)) <= half, axis=-1)
        found = replace(grid, occupied=grid.occupied | box)
        if label(found.clearance > PASSABLE)[1] == pieces:
            return found
    return grid
