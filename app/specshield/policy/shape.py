"""How many rows, columns and headings a lattice has."""

from __future__ import annotations

import math

import numpy as np

from specshield.robot.dynamics import Body
from specshield.task import Task
from specshield.world.occupancy import OccupancyGrid

MAX_HEADINGS = 120
FEWEST_HEADINGS, USUAL_HEADINGS = 24, 72  # where none fits every turn exactly: 15 to 5 degrees each
# [headings] How far a turn may be off a multiple of a heading to count as exact, and as nearly exact: ten
# turns that are off by NEAR_HEADING make half a heading. Chosen by hand.
SAME_HEADING, NEAR_HEADING = 1e-3, 0.05


def heading_count(rotations: list[float]) -> int:
    """The fewest headings, 4 to MAX_HEADINGS, of which every rotation [rad] is exactly a multiple.

    If there are none, the fewest from FEWEST_HEADINGS on of which every rotation is nearly a multiple, else
    USUAL_HEADINGS.
    """

    def error(n: int) -> float:
        steps = np.array(rotations) * n / (2.0 * math.pi)
        return float(np.abs(steps - np.round(steps)).max(initial=0.0))

    for n in range(4, MAX_HEADINGS + 1):
        if error(n) < SAME_HEADING:
            return n
    odd = range(FEWEST_HEADINGS, USUAL_HEADINGS + 1)
    return next((n for n in odd if error(n) < NEAR_HEADING), USUAL_HEADINGS)


def headings_of(task: Task) -> int:
    """The headings of a task's lattice."""
    return heading_count([turn for _, turn in task.robot.motions if turn != 0.0])


def side_of(grid: OccupancyGrid | Body, pitch: float) -> tuple[int, int]:
    """Rows and columns of a lattice on a map."""
    ny, nx = (max(math.ceil(n * grid.resolution / pitch - 1e-9), 1) for n in grid.occupied.shape)
    return ny, nx
