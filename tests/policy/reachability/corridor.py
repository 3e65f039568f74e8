"""A corridor of six whole cells, 0.2 m each, for tables that can be worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from specshield.caution.surprise.barred import NOTHING_BARRED
from specshield.policy.progress import make_rules
from specshield.policy.reachability.policy import Settings, synthesise
from specshield.policy.reachability.tables import Guide
from specshield.robot.dynamics import make_body
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.cells import CELL, ROBOT, WAIT

RESTLESS = replace(ROBOT, name="restless", actions=ROBOT.actions[:WAIT])
EAST, NORTH, WEST, SOUTH = range(4)


def make_corridor(formula, robot=ROBOT, **cells):
    """The task; cells: {region: column}."""
    regions = {
        name: {"type": "rectangle", "min": [i * CELL, 0.0], "max": [(i + 1) * CELL, CELL]}
        for name, i in cells.items()
    }
    return make_task(OccupancyGrid(np.zeros((1, 6), bool), CELL), robot, formula, regions)


def guide_of(task):
    tables = synthesise(task, Settings(pitch=CELL * 3)).tables  # a third of it is used: the map is small
    return Guide(
        make_body(task.robot, task.grid), make_rules(task), tables, task.robot.wait_motion, NOTHING_BARRED
    )


def pose(column, heading=EAST):
    return np.array([(column + 0.5) * CELL, 0.5 * CELL, (0.0, 0.5, 1.0, -0.5)[heading] * np.pi])
