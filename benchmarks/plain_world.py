"""The known dynamics and the regions again, in NumPy: the formulas of robot/, batched over poses.

Written apart from the compiled kernels, so that agreement in J says something. Two things are left out, and
asserted instead: a robot that begins inside an obstacle, and regions other than circles and rectangles.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from specshield.robot.contact import ROUNDING, SKIN
from specshield.stl import And, Atom, Formula, Not, Or
from specshield.task import Task
from specshield.world.regions import Circle, Rectangle, Region

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class World:
    """f of a robot on a grid, for poses [N, 3]. Only grids whose yaw is 0."""

    def __init__(self, task: Task) -> None:
        grid, robot = task.grid, task.robot
        assert grid.origin[2] == 0.0, "the plain dynamics know grids along the map's axes only"
        self.h, self.origin = grid.resolution, np.array(grid.origin[:2])
        self.radius, self.offset, self.stops = robot.radius, robot.offset, robot.on_contact == "stop"
        self.motions = np.array(robot.motions)
        # Cells that any move can touch, and a ring wide enough that no window of them leaves the array.
        reach = robot.radius + np.abs(self.motions[:, 0]).max() + 2.0 * math.hypot(*robot.offset)
        self.half = math.ceil(reach / self.h) + 1
        self.occupied = np.pad(grid.occupied, self.half + 1, constant_values=True)
        self.clearance = np.pad(grid.clearance, self.half + 1)
        self.window = np.arange(-self.half, self.half + 1)

    def next_poses(self, poses: Floats, motions: NDArray[np.int64]) -> Floats:
        """The pose after each motion: poses [N, 3], motions [N], result [N, 3]."""
        x, y, theta = poses.T
        distance, angle = self.motions[motions].T
        moved = self._moved(x, y, theta, distance)
        short = moved != distance
        if not self.stops:
            moved = np.where(short, 0.0, moved)
        nx, ny = x + moved * np.cos(theta), y + moved * np.sin(theta)
        turns = (angle != 0.0) & ~short
        turned = turns.copy()
        turned[turns] = self._can_turn(nx[turns], ny[turns], theta[turns], angle[turns])
        if not self.stops:
            blocked = turns & ~turned
            nx, ny = np.where(blocked, x, nx), np.where(blocked, y, ny)
        return np.stack([nx, ny, np.where(turned, wrap(theta + angle), theta)], axis=-1)

    def _centre(self, x: Floats, y: Floats, theta: Floats) -> Floats:
        """The footprint's centre in grid metres, [N, 2]."""
        (ox, oy), c, s = self.offset, np.cos(theta), np.sin(theta)
        return np.stack([x + ox * c - oy * s, y + ox * s + oy * c], axis=-1) - self.origin

    def _is_clear(self, at: Floats, distance: Floats | float) -> Bools:
        """Whether the clearance of the cell shows no obstacle within `distance` of points [N, 2]."""
        cell = np.floor(at / self.h)
        column, row = cell.astype(int).T + self.half + 1
        off_centre = np.hypot(*(at - (cell + 0.5) * self.h).T)
        clear: Bools = self.clearance[row, column] - off_centre >= distance
        return clear & ~self.occupied[row, column]

    def _moved(self, x: Floats, y: Floats, theta: Floats, distance: Floats) -> Floats:
        """How far of `distance` the robot can go straight on, [N]."""
        moved = distance.copy()
        at, length = self._centre(x, y, theta), np.abs(distance)
        near = np.flatnonzero((distance != 0.0) & ~self._is_clear(at, self.radius + length))
        if len(near):
            sign = np.sign(distance[near])
            way = (sign * np.stack([np.cos(theta[near]), np.sin(theta[near])])).T
            contact = self._first_contact(at[near], way, length[near], self._room(at[near]))
            moved[near] = np.where(contact == np.inf, distance[near], sign * np.maximum(contact - SKIN, 0.0))
        return moved

    def _can_turn(self, x: Floats, y: Floats, theta: Floats, angle: Floats) -> Bools:
        free = np.ones(len(x), np.bool_)
        if self.offset == (0.0, 0.0) or not len(x):
            return free
        at = self._centre(x, y, theta)
        near = np.flatnonzero(~self._is_clear(at, self.radius + 2.0 * math.hypot(*self.offset)))
        for i in near:
            about, room = np.array([x[i], y[i]]) - self.origin, self._room(at[i : i + 1])
            free[i] = self._arc_gap(at[i], about, angle[i]) >= room[0]
        return free

    def _arc_gap(self, at: Floats, about: Floats, angle: float) -> float:
        """The distance of the taken cells from the arc that a point [2] goes about another."""
        u0, v0, taken = self._boxes(at[None])
        low = np.stack([u0[taken], v0[taken]], axis=-1)[:, None]  # [squares, 1, 2]
        reach, start = math.hypot(*(at - about)), math.atan2(*(at - about)[::-1])
        edges = low + self.h * np.arange(2)[:, None] - about  # [squares, 2, 2]
        corners = np.arctan2(edges[:, (0, 0, 1, 1), 1], edges[:, (0, 1, 0, 1), 0])
        crossed = np.arccos(np.clip(edges / reach, -1.0, 1.0))
        sides = [sign * crossed[..., k] + k * 0.5 * math.pi for sign in (1, -1) for k in (0, 1)]
        along = np.broadcast_to(0.5 * math.pi * np.arange(4), (len(low), 4))
        turned = np.concatenate([corners, *sides, along], axis=1) - start
        passed = np.mod(math.copysign(1.0, angle) * turned, 2.0 * math.pi)
        passed = np.concatenate([passed, np.zeros((len(low), 1)), np.full((len(low), 1), abs(angle))], axis=1)
        way = start + math.copysign(1.0, angle) * np.minimum(passed, abs(angle))
        points = about + reach * np.stack([np.cos(way), np.sin(way)], axis=-1)
        beyond = np.maximum(np.maximum(low - points, points - low - self.h), 0.0)
        return float(np.hypot(*np.moveaxis(beyond, -1, 0)).min(initial=np.inf))

    def _boxes(self, at: Floats) -> tuple[Floats, Floats, Bools]:
        """The cells around points [N, 2]: lower corners u0, v0 [N, W, W] [m], which are taken."""
        column, row = np.floor(at / self.h).astype(int).T
        columns, rows = column[:, None] + self.window, row[:, None] + self.window
        taken = self.occupied[(rows + self.half + 1)[:, :, None], (columns + self.half + 1)[:, None, :]]
        u0, v0 = np.broadcast_arrays((columns * self.h)[:, None, :], (rows * self.h)[:, :, None])
        return u0, v0, taken

    def _room(self, at: Floats) -> Floats:
        """The radius that is tested from points [N, 2]: never more than the room there is."""
        u0, v0, taken = self._boxes(at)
        u, v = at.T[:, :, None, None]
        du = np.maximum(np.maximum(u0 - u, 0.0), u - (u0 + self.h))
        dv = np.maximum(np.maximum(v0 - v, 0.0), v - (v0 + self.h))
        gap = np.sqrt(np.where(taken, du * du + dv * dv, np.inf).min(axis=(1, 2)))
        assert np.all(gap > 0.0), "the plain dynamics do not know what happens inside an obstacle"
        return np.minimum(self.radius - ROUNDING, gap - 1e-12)

    def _first_contact(self, at: Floats, way: Floats, length: Floats, r: Floats) -> Floats:
        """How far discs of radius r [N] move from points [N, 2] along unit vectors until they touch."""
        u0, v0, taken = self._boxes(at)
        u0, v0 = u0[taken], v0[taken]
        row = np.nonzero(taken)[0]
        u, v, du, dv, r = at[row, 0], at[row, 1], way[row, 0], way[row, 1], r[row]
        u1, v1 = u0 + self.h, v0 + self.h
        first = np.minimum(
            _enters_box(u, v, du, dv, u0 - r, u1 + r, v0, v1),
            _enters_box(u, v, du, dv, u0, u1, v0 - r, v1 + r),
        )
        for cu in (u0, u1):
            for cv in (v0, v1):
                first = np.minimum(first, _enters_disc(u, v, du, dv, cu, cv, r))
        contact = np.full(len(at), np.inf)
        np.minimum.at(contact, row, first)
        return np.where(contact < length, contact, np.inf)


def wrap(theta: Floats) -> Floats:
    """Angles in (-pi, pi]."""
    turned = theta - np.ceil((theta - math.pi) / (2.0 * math.pi)) * 2.0 * math.pi
    return np.where((-math.pi < theta) & (theta <= math.pi), theta, turned)


def predicate(formula: Formula, task: Task) -> Callable[[Floats], Floats]:
    """The robustness of a boolean combination of regions, as a function of points [..., 2]."""
    match formula:
        case Atom(name):
            return _distance(task.regions[name])
        case Not(child):
            inner = predicate(child, task)
            return lambda points: -inner(points)
        case And(children) | Or(children):
            parts = [predicate(child, task) for child in children]
            extremum = np.minimum if isinstance(formula, And) else np.maximum
            return lambda points: extremum.reduce([part(points) for part in parts])
    raise NotImplementedError(f"no plain version of {formula}")


def _distance(region: Region) -> Callable[[Floats], Floats]:
    if isinstance(region, Circle):
        centre, radius = np.array(region.center), region.radius
        return lambda points: radius - np.hypot(*np.moveaxis(points - centre, -1, 0))
    assert isinstance(region, Rectangle), "the plain regions are circles and rectangles"
    low, high = np.array(region.min), np.array(region.max)

    def inside(points: Floats) -> Floats:
        beyond = np.maximum(low - points, points - high)
        outside = np.hypot(*np.moveaxis(np.maximum(beyond, 0.0), -1, 0))
        return np.where(outside > 0.0, -outside, -beyond.max(axis=-1))

    return inside


def _enters_slab(p: Floats, d: Floats, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = (low - p) / d, (high - p) / d
    between = (low < p) & (p < high)
    still = d == 0.0
    enter = np.where(still, np.where(between, -np.inf, np.inf), np.minimum(first, last))
    leave = np.where(still, np.where(between, np.inf, -np.inf), np.maximum(first, last))
    return enter, leave


def _enters_box(
    u: Floats, v: Floats, du: Floats, dv: Floats, u0: Floats, u1: Floats, v0: Floats, v1: Floats
) -> Floats:
    a0, a1 = _enters_slab(u, du, u0, u1)
    b0, b1 = _enters_slab(v, dv, v0, v1)
    enter, leave = np.maximum(a0, b0), np.minimum(a1, b1)
    return np.where((enter < leave) & (leave > 0.0), np.maximum(enter, 0.0), np.inf)


def _enters_disc(u: Floats, v: Floats, du: Floats, dv: Floats, cu: Floats, cv: Floats, r: Floats) -> Floats:
    qu, qv = u - cu, v - cv
    along = qu * du + qv * dv
    under = along * along - (qu * qu + qv * qv - r * r)
    root = np.sqrt(np.maximum(under, 0.0))
    return np.where((under > 0.0) & (root - along > 0.0), np.maximum(-along - root, 0.0), np.inf)
