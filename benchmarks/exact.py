"""A search for a pose, in exact poses, that knows nothing of lattices, tables or policies.

Breadth first from the start: every motion from every pose, simulated by f. Poses that are nearly the same
count once, told apart finely about the goal and coarsely elsewhere. What it finds is a way that the robot can
go; what it does not find may exist all the same.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from specshield.robot.dynamics import Body, motion_count, step

# Not cached: on the disk it would not notice that the package's functions changed.
compiled: Any = numba.njit
Floats = NDArray[np.float64]
FINE, COARSE = 0.01, 0.1  # [m] what poses are told apart by, near the goal and elsewhere
ABOUT = 0.6  # [m] how far from the goal is near
DEGREES = 1.0  # what headings are told apart by
MOST = 3_000_000  # poses of one search
NOWHERE = np.empty((0, 3))  # no discs to keep out of


class Goal(NamedTuple):
    """A disc and bounds on theta, x and y, which all have to hold: those that are not meant are infinite."""

    x: float = 0.0
    y: float = 0.0
    radius: float = math.inf
    theta: tuple[float, float] = (-math.inf, math.inf)
    xs: tuple[float, float] = (-math.inf, math.inf)
    ys: tuple[float, float] = (-math.inf, math.inf)

    def formula(self) -> str:
        """As a rule says it, with the region Dock for the disc."""
        parts = ["Dock"] if self.radius < math.inf else []
        for name, (low, high) in (("theta", self.theta), ("x", self.xs), ("y", self.ys)):
            parts += [f"{name} > {low!r}"] if low > -math.inf else []
            parts += [f"{name} < {high!r}"] if high < math.inf else []
        return f"({' and '.join(parts)})"

    def holds(self, poses: Floats) -> NDArray[np.bool_]:
        """At poses [..., 3]."""
        x, y, theta = np.moveaxis(poses, -1, 0)
        inside = np.hypot(x - self.x, y - self.y) < self.radius
        for values, (low, high) in ((theta, self.theta), (x, self.xs), (y, self.ys)):
            inside &= (values > low) & (values < high)
        return np.asarray(inside)


@compiled
def _is_near(goal: Goal, x: float, y: float) -> bool:
    off = math.hypot(x - goal.x, y - goal.y) - goal.radius if goal.radius < math.inf else -math.inf
    off = max(off, goal.xs[0] - x, x - goal.xs[1], goal.ys[0] - y, y - goal.ys[1])
    return -math.inf < off < ABOUT


@compiled
def _is_at(goal: Goal, x: float, y: float, theta: float) -> bool:
    if goal.radius < math.inf and not math.hypot(x - goal.x, y - goal.y) < goal.radius:
        return False
    return (
        goal.theta[0] < theta < goal.theta[1] and goal.xs[0] < x < goal.xs[1] and goal.ys[0] < y < goal.ys[1]
    )


@compiled
def _is_out(shut: Floats, x: float, y: float) -> bool:
    out = True
    for n in range(shut.shape[0]):
        out = out and math.hypot(x - shut[n, 0], y - shut[n, 1]) > shut[n, 2]
    return out


@compiled
def fewest_steps(
    body: Body, goal: Goal, x: float, y: float, theta: float, steps: int, most: int, shut: Floats
) -> int:
    """The fewest steps found, up to `steps`, to a pose where the goal holds; -1 where none is found.

    shut [n, 3]: discs, as x, y and radius, that no pose before that one is in.
    """
    if _is_at(goal, x, y, theta):
        return 0
    poses = np.empty((most, 3))
    slots = 1
    while slots < 2 * most:
        slots *= 2
    seen = np.full(slots, -1, np.int64)
    poses[0, 0], poses[0, 1], poses[0, 2] = x, y, theta
    begin, end, count = 0, 1, 1
    for made in range(1, steps + 1):
        for here in range(begin, end):
            for m in range(motion_count(body)):
                x, y, theta = step(body, poses[here, 0], poses[here, 1], poses[here, 2], m)
                if _is_at(goal, x, y, theta):
                    return made
                if not _is_out(shut, x, y):
                    continue
                grain = FINE if _is_near(goal, x, y) else COARSE
                i, j = math.floor(x / grain) + (1 << 20), math.floor(y / grain) + (1 << 20)
                h = math.floor(math.degrees(theta) / DEGREES + 0.5) + 512
                key = ((i << 21 | j) << 11 | h) << 1 | (grain == FINE)
                slot = (key * 0x9E3779B97F4A7C1 >> 20) & (slots - 1)
                while seen[slot] != -1 and seen[slot] != key:
                    slot = (slot + 1) & (slots - 1)
                if seen[slot] == key:
                    continue
                if count == most:
                    return -1
                seen[slot] = key
                poses[count, 0], poses[count, 1], poses[count, 2] = x, y, theta
                count += 1
        begin, end = end, count
        if begin == end:
            break
    return -1
