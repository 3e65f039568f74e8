"""The floor as squares: where the footprint's centre may be, how long the ways between squares are at least,
and how high a predicate can be in a square.

All of it errs on the side of more: a square counts as free if some point of it is, ways are never measured
longer than they are, and a predicate counts as possible if interval arithmetic does not rule it out. So what
is impossible here is impossible for the robot.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, field

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.compiled import kernel, leaf
from specshield.robot.dynamics import Body, displacements
from specshield.stl import And, Atom, Comparison, Formula, Not, Or
from specshield.stl.robustness import difference
from specshield.stl.terms import interval
from specshield.task import Task
from specshield.world.regions import pack_areas, signed_distance

# Chosen by hand: the ways to one goal, and one region, take 0.1 s at most.
MOST_SQUARES = 150_000  # a larger map has larger squares
MOST_WORK = 50_000_000  # squares times the numbers that describe the regions; beyond that they are larger too
SPARE = 2e-3  # [m] by which the footprint counts as smaller: more than f allows it to overlap in its turns
LONGER = 1.0 / math.cos(math.atan(0.5) / 2.0)  # ways along 16 directions are at most 2.8 % too long
Interval = tuple[Floats, Floats]


@dataclass(frozen=True)
class Ground:
    """Squares [ny, nx] of `side` [m] in the grid's frame.

    free: where the footprint's centre may be. centres [ny, nx, 2] in the map frame. span: how far a point of
    a square lies from its centre [m]. travel: how far the footprint's centre comes in one step, at most [m].
    values: what each signal is held at.
    """

    task: Task
    side: float
    free: Bools
    centres: Floats
    span: float
    travel: float
    values: dict[str, float]
    kept: dict[object, Floats] = field(default_factory=dict)  # what was computed already

    def squares(self, poses: Floats) -> tuple[Ints, Ints]:
        """Rows and columns, [n] each, of the squares that the footprint's centre is in at poses [n, 3]."""
        ahead, left = self.task.robot.offset
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        centre = poses[:, :2] + np.column_stack([ahead * cos - left * sin, ahead * sin + left * cos])
        at = np.floor(self.task.grid.to_grid(centre) / self.side).astype(np.int64)
        ny, nx = self.free.shape
        return np.clip(at[:, 1], 0, ny - 1), np.clip(at[:, 0], 0, nx - 1)

    def highest(self, predicate: Formula, beyond: float = 0.0) -> Floats:
        """An upper bound on rho of a predicate, in the form of `needs.positive`, wherever the footprint's
        centre is in a square or at most `beyond` [m] from it. Shape [ny, nx].
        """
        key = predicate, beyond
        if key not in self.kept:
            kept = frozenset(predicate.children if isinstance(predicate, And) else (predicate,))
            self.kept[key] = self._rho(predicate, kept, beyond)[1]
        return self.kept[key]

    def _rho(self, predicate: Formula, kept: frozenset[Formula], beyond: float) -> Interval:
        """Bounds on rho, given that the predicates `kept` hold as well."""
        match predicate:
            case And(children) | Or(children):
                bounds = [self._rho(child, kept, beyond) for child in children]
                join = np.minimum if isinstance(predicate, And) else np.maximum
                return join.reduce([low for low, _ in bounds]), join.reduce([high for _, high in bounds])
            case Not(child):
                low, high = self._rho(child, frozenset(), beyond)
                return self._unless(child in kept, -high, -low)
            case Atom() | Comparison():
                ends = interval(difference(predicate), lambda name: self._read(name, beyond))
                low, high = (np.broadcast_to(end, self.free.shape) for end in ends)
                return self._unless(Not(predicate) in kept, low, high)
        return np.full(self.free.shape, -np.inf), np.full(self.free.shape, np.inf)

    def _unless(self, contradicted: bool, low: Floats, high: Floats) -> Interval:
        return low, np.full_like(high, -np.inf) if contradicted else high

    def _read(self, name: str, beyond: float) -> Interval:
        off = math.hypot(*self.task.robot.offset)
        if name in self.task.areas:
            area = self.task.areas[name]
            ahead, left = self.task.robot.offset
            apart = math.hypot(area.point[0] - ahead, area.point[1] - left)
            value = signed_distance(area.region, self.centres) + area.grown  # at the footprint's centre
            wide = self.span + apart + beyond
        elif name in ("x", "y"):
            value, wide = self.centres[..., int(name == "y")], self.span + off + beyond
        elif name == "theta":
            value, wide = np.zeros(self.free.shape), math.pi
        else:
            value, wide = np.full(self.free.shape, self.values[name]), 0.0
        return value - wide, value + wide

    def ways_to(self, goal: Bools, free: Bools) -> Floats:
        """The length [m] of the shortest way from each square to some square of `goal`, through squares that
        are `free`, or less. Infinite where there is none. All of shape [ny, nx].
        """
        key = goal.tobytes(), free.tobytes()
        if key not in self.kept:
            found = _ways(goal & free, free) * (self.side / LONGER) - math.sqrt(2.0) * self.side
            self.kept[key] = np.maximum(found, 0.0)
        return self.kept[key]

    def steps(self, ways: Floats) -> Floats:
        """The fewest steps that ways of these lengths [m] take, of any shape."""
        if self.travel > 0.0:
            return np.ceil(ways / self.travel - 1e-9)
        return np.where(ways > 0.0, np.inf, 0.0)


def make_ground(task: Task, body: Body, values: dict[str, float]) -> Ground:
    """The floor of the body's map. values: what the signals are held at."""
    grid = task.grid
    room = body.clearance + grid.resolution * math.sqrt(0.5) >= task.robot.radius - SPARE
    numbers = pack_areas(list(task.areas.values())).data.size
    most = min(MOST_SQUARES, MOST_WORK // max(numbers, 1))
    many = max(1, math.ceil(math.sqrt(grid.height * grid.width / max(most, 1))))
    ny, nx = -(-grid.height // many), -(-grid.width // many)
    padded = np.zeros((ny * many, nx * many), np.bool_)
    padded[: grid.height, : grid.width] = room & (body.occupied == 0)
    free: Bools = np.any(padded.reshape(ny, many, nx, many), axis=(1, 3))
    side = many * grid.resolution
    columns, rows = np.meshgrid(np.arange(nx) + 0.5, np.arange(ny) + 0.5)
    centres = grid.to_map(np.stack([columns, rows], axis=-1) * side)
    moves, turns = displacements(body)
    travel = float((np.abs(moves) + np.abs(turns) * math.hypot(*task.robot.offset)).max())
    return Ground(task, side, free, centres, side * math.sqrt(0.5), travel, values)


@kernel
def _ways(goal: Bools, free: Bools) -> Floats:
    """The shortest way [squares] from any corner of each square to a corner of a goal, by moves of one square
    along an edge or a diagonal, and of two squares ahead and one aside.

    A shortest way through the floor bends only at corners of squares. Each straight part of it, from corner
    to corner, can be replaced by such moves through the squares that it crosses, which are at most LONGER
    times as long: where it rises by one row in two columns, that is one move of the last kind.
    """
    ny, nx = free.shape
    far = np.full((ny + 1, nx + 1), np.inf)
    heap = [(0.0, -1)]
    for j in range(ny):
        for i in range(nx):
            if goal[j, i]:
                for corner in range(4):
                    y, x = j + (corner >> 1), i + (corner & 1)
                    if far[y, x] > 0.0:
                        far[y, x] = 0.0
                        heapq.heappush(heap, (0.0, y * (nx + 1) + x))
    while len(heap) > 0:
        gone, at = heapq.heappop(heap)
        y, x = at // (nx + 1), at % (nx + 1)
        if at < 0 or gone > far[y, x]:
            continue
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                j, i, size = y + dy, x + dx, abs(dy) + abs(dx)
                if (
                    size == 0
                    or size > 3
                    or (size == 2 and dy * dx == 0)
                    or not (0 <= j <= ny and 0 <= i <= nx)
                ):
                    continue
                if not _is_open(free, y, x, j, i):
                    continue
                length = gone + math.sqrt(float(dy * dy + dx * dx))
                if length < far[j, i]:
                    far[j, i] = length
                    heapq.heappush(heap, (length, j * (nx + 1) + i))
    out = np.full((ny, nx), np.inf)
    for j in range(ny):
        for i in range(nx):
            if free[j, i]:
                out[j, i] = min(min(far[j, i], far[j, i + 1]), min(far[j + 1, i], far[j + 1, i + 1]))
    return out


@leaf
def _is_open(free: Bools, y: int, x: int, j: int, i: int) -> bool:
    """Whether a move between two corners is free: each square that it crosses, or one beside an edge."""
    ny, nx = free.shape
    if y == j or x == i:
        row, col = min(y, j), min(x, i)
        here = row < ny and col < nx and free[row, col]
        other_row, other_col = (row - 1, col) if y == j else (row, col - 1)
        return bool(here or (other_row >= 0 and other_col >= 0 and free[other_row, other_col]))
    for row in range(min(y, j), max(y, j)):
        for col in range(min(x, i), max(x, i)):
            if not free[row, col]:
                return False
    return True
