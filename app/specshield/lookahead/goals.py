"""The places that a model may be going to, spread over the free space, and the way to each of them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt, label

from specshield.arrays import Bools, Codes, Floats, Int8s
from specshield.compiled import kernel, leaf
from specshield.policy.geodesic import downhill, falling, geodesic_distance
from specshield.robot.body import in_grid
from specshield.robot.dynamics import Body, swing_radius
from specshield.world.occupancy import OccupancyGrid

MAX_GOALS = 300  # keeps a decision short: each goal is compared with what the model says at every step
GAP = 0.5  # [m] between goals, where that makes no more than MAX_GOALS
WAY_PITCH = 0.1  # [m] of the grid that ways are kept on, where that makes no more than MAX_CELLS
MAX_CELLS = 20_000  # keeps memory small: MAX_GOALS fields of so many cells and 4 bytes are 24 MB
STEER = 5  # [cells] how far along the way lies the point for which the robot steers
UNIT = 127  # of a direction's components, as stored in a byte
NO_PATH = 65535  # [cm] the distance from where no path leads to a goal


class Goals(NamedTuple):
    """G goals of a robot on its map and the way to each, on a grid of h x w cells of `pitch` [m] in the grid
    frame.

    distance [G, h, w] [cm]: along space in which the robot can turn, plus the way from beside an obstacle to
    that space; through doors too narrow to turn in if there is no other way; NO_PATH if there is none at all.
    way [G, h, w, 2]: the direction (u, v) to go, times UNIT; zero at the goal.
    """

    body: Body
    pitch: float
    distance: Codes
    way: Int8s


def make_goals(body: Body, grid: OccupancyGrid) -> Goals:
    """Goals all over the space in which the robot can turn freely."""
    height, width = grid.occupied.shape
    cells = max(round(WAY_PITCH / grid.resolution), math.ceil(math.sqrt(height * width / MAX_CELLS)), 1)
    pitch = cells * grid.resolution
    middles = [np.arange(n // cells) * cells + cells // 2 for n in (height, width)]
    clearance = body.clearance[np.ix_(*middles)]
    free = clearance > 0.0
    roomy = clearance > swing_radius(body)
    places = _places(roomy, max(round(GAP / pitch), 1))
    beside, nearest = distance_transform_edt(~roomy, sampling=pitch, return_indices=True)
    distance = np.empty((len(places), *free.shape), np.uint16)
    way = np.empty((len(places), *free.shape, 2), np.int8)
    rooms, _ = label(roomy)  # the goals in one room are reached from the same places
    off = {room: geodesic_distance(free, rooms == room, pitch) for room in {rooms[r, c] for r, c in places}}
    for g, (row, column) in enumerate(places):
        goal = np.zeros_like(free)
        goal[row, column] = True
        onward = geodesic_distance(roomy, goal, pitch)
        to_go = onward[tuple(nearest)] + beside
        if np.any(free & np.isinf(to_go)):  # through a door too narrow to turn in
            to_go = np.where(np.isinf(to_go), geodesic_distance(free, goal, pitch), to_go)
        distance[g] = np.where(np.isfinite(to_go), np.minimum(100.0 * to_go, NO_PATH - 1), NO_PATH)
        _steer(falling(onward, off[rooms[row, column]], pitch), way[g])
    return Goals(body, pitch, distance, way)


def _places(roomy: Bools, gap: int) -> list[tuple[int, int]]:
    """One roomy cell in each square of `gap` cells, the middlemost. The squares grow until there are at most
    MAX_GOALS.
    """
    places: list[tuple[int, int]] = []
    for row in range(0, roomy.shape[0], gap):
        for column in range(0, roomy.shape[1], gap):
            found = np.argwhere(roomy[row : row + gap, column : column + gap])
            if len(found):
                r, c = found[int(np.argmin(np.sum((found - (gap - 1) / 2) ** 2, axis=1)))]
                places.append((row + int(r), column + int(c)))
    return places if len(places) <= MAX_GOALS else _places(roomy, gap + 1)


@kernel
def _steer(height: Floats, way: Int8s) -> None:
    """The direction from each cell to the one STEER cells down the steepest way."""
    columns = height.shape[1]
    for start, at in enumerate(downhill(height, STEER)):
        dv, du = at // columns - start // columns, at % columns - start % columns
        length = max(math.hypot(du, dv), 1e-9)
        way[start // columns, start % columns, 0] = round(UNIT * du / length)
        way[start // columns, start % columns, 1] = round(UNIT * dv / length)


@leaf
def cell_of(goals: Goals, x: float, y: float) -> tuple[int, int]:
    """Row and column of the goals' grid at a point of the map frame; the nearest cell for one outside."""
    (u, v), (_, height, width) = in_grid(goals.body, x, y), goals.distance.shape
    return min(max(int(v / goals.pitch), 0), height - 1), min(max(int(u / goals.pitch), 0), width - 1)
