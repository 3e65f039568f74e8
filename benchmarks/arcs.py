"""Turns on their true arcs: whether one that f makes overlaps an obstacle, or one that is free is refused.

    python -m benchmarks.arcs [--turns 100000] [--houses 2] [--seed 0]

The Stretch turns beside what it may touch, in the two case apartments and in houses drawn by seed. The arc is
sampled (every 1 mm, and every 20 micrometres where that leaves open whether it is free) against all occupied
cells, without the package's contact geometry. Prints the turns made and refused, the deepest overlap of one
that was made, and the most room that one that was refused had left.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from evaluation.model.floor_plans import random_house
from specshield.robot import STRETCH
from specshield.robot.dynamics import make_body, step
from specshield.sim.cases import load_case
from specshield.world.occupancy import OccupancyGrid

Floats = NDArray[np.float64]
NEAR = 0.03  # [m] of an obstacle, beyond the radius, begin the turns that are tried
COARSE, FINE = 1e-3, 2e-5  # [m] between samples of an arc


class Squares:
    """The occupied cells of a grid, and the ring about it, as squares in grid metres."""

    def __init__(self, grid: OccupancyGrid) -> None:
        self.h, (self.x, self.y, self.yaw) = grid.resolution, grid.origin
        self.window = math.ceil(0.7 / self.h)  # more than a disc reaches on its arc from where it begins
        self.taken = np.pad(grid.occupied, self.window + 1, constant_values=True)

    def centres(self, pose: Floats, headings: Floats) -> Floats:
        """The centre of the footprint at each heading [n, 2], in grid metres."""
        z = complex(*pose[:2]) + complex(*STRETCH.offset) * np.exp(1j * headings) - complex(self.x, self.y)
        turned = z * np.exp(-1j * self.yaw)
        return np.column_stack([turned.real, turned.imag])

    def gap(self, points: Floats) -> float:
        """The least distance of points [n, 2], all near the first, from a square; inf for a long one."""
        column, row = np.floor(points[0] / self.h).astype(int)
        size = 2 * self.window + 1
        rows, columns = np.nonzero(self.taken[row + 1 : row + 1 + size, column + 1 : column + 1 + size])
        squares = (np.column_stack([columns + column, rows + row]) - self.window) * self.h
        low = squares - points[0]
        reach = np.hypot(*(points - points[0]).T).max() + STRETCH.radius + NEAR
        squares = squares[np.hypot(*np.maximum(0.0, np.maximum(low, -low - self.h)).T) < reach]
        low = squares[None] - points[:, None]
        outside = np.maximum(0.0, np.maximum(low, -low - self.h))
        return float(np.sqrt((outside**2).sum(axis=-1).min(initial=np.inf)))


def room_left(squares: Squares, pose: Floats, angle: float) -> float:
    """How far the disc stays from every square on its arc [m], to FINE / 2 where that is next to nothing."""
    length = abs(angle) * math.hypot(*STRETCH.offset)
    for spacing in (COARSE, FINE):
        count = math.ceil(length / spacing) + 1
        room = squares.gap(squares.centres(pose, pose[2] + angle * np.linspace(0.0, 1.0, count)))
        room -= STRETCH.radius
        if abs(room) > spacing:
            break
    return room


def turns(grid: OccupancyGrid, random: np.random.Generator) -> Iterator[tuple[bool, float]]:
    """Without end: whether f made a turn, and the room that was left on its arc."""
    squares, body = Squares(grid), make_body(STRETCH, grid)
    size = np.array([grid.width, grid.height]) * grid.resolution
    while True:
        x, y = grid.to_map(random.random(2) * size)
        pose = np.array([x, y, random.uniform(-math.pi, math.pi)])
        gap = squares.gap(squares.centres(pose, pose[2:])) - STRETCH.radius
        if not 0.0 < gap < NEAR:
            continue
        for motion, (move, angle) in enumerate(STRETCH.motions):
            if move == 0.0 and angle != 0.0:
                x, y, theta = pose.tolist()
                made = step(body, x, y, theta, motion)[2] != pose[2]
                yield made, room_left(squares, pose, angle)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=100_000, help="that f makes, in all")
    parser.add_argument("--houses", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    random = np.random.default_rng(asked.seed)
    grids = {name: load_case(name).task.grid for name in ("case1", "case2")}
    grids |= {f"house {i}": random_house(random).grid for i in range(asked.houses)}
    print("| map | made | refused | deepest overlap [um] | most room of a refused one [um] |")
    print("|---|--:|--:|--:|--:|")
    for name, grid in grids.items():
        room: dict[bool, list[float]] = {True: [], False: []}
        found = turns(grid, random)
        while len(room[True]) < asked.turns / len(grids):
            made, left = next(found)
            room[made].append(left)
        deepest, most = max(0.0, -min(room[True])), max(room[False], default=0.0)
        counts = f"{len(room[True])} | {len(room[False])}"
        print(f"| {name} | {counts} | {1e6 * deepest:.4f} | {1e6 * most:.1f} |", flush=True)


if __name__ == "__main__":
    main()
