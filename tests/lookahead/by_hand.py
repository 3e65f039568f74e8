"""A world of two cells side by side and a robot on a rail: small enough for every figure to be by hand.

The robot faces east. `go` takes it from the western cell to the eastern one, `back` the other way; at either
end it is stopped. B is the eastern cell.
"""

from __future__ import annotations

import numpy as np

from specshield.lookahead.goals import Goals
from specshield.lookahead.lattice import make_planes
from specshield.policy.progress import make_rules
from specshield.robot import robot_from_json
from specshield.robot.dynamics import make_body
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid

GO, BACK, STOP = range(3)
WEST, EAST = (0.1, 0.1, 0.0), (0.3, 0.1, 0.0)
RAIL = robot_from_json(
    {
        "footprint": {"radius": 0.09},
        "actions": [{"name": "go", "translate": 0.2}, {"name": "back", "translate": -0.2}, {"name": "stop"}],
    }
)


def make_world(formula):
    """body, rules and planes; the lattice has the two cells as its own."""
    region = {"B": {"type": "rectangle", "min": [0.2, 0.0], "max": [0.4, 0.2]}}
    task = make_task(OccupancyGrid(np.zeros((1, 2), bool), 0.2), RAIL, formula, region)
    body, rules = make_body(RAIL, task.grid), make_rules(task)
    return body, rules, make_planes(body, rules, task.horizon, pitch=0.2)


def place(planes, column):
    """Where a plane has a cell: 0 for the western one, 1 for the eastern."""
    return planes.pad * planes.width + planes.pad + column


def goals_of(body, *ways, distance=300):
    """A goal for each direction (u, v) to go, all [cm] away, on a grid of one cell."""
    way = np.array(ways, np.int8).reshape(-1, 1, 1, 2)
    return Goals(body, 1.0, np.full((len(ways), 1, 1), distance, np.uint16), way)
