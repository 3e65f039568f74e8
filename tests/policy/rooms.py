"""Small worlds for policies: a flat of two rooms joined by a door, 4 x 3 m, and a bare corridor."""

from __future__ import annotations

import math

import numpy as np

from specshield.policy.card import make_card
from specshield.policy.dqn.network import NAMES, make_network
from specshield.policy.dqn.observation import make_state, observation_size, place
from specshield.policy.dqn.policy import Policy
from specshield.policy.progress import PENDING, make_rules
from specshield.robot import STRETCH, robot_from_json
from specshield.robot.dynamics import make_body, motion_count, successors
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid

OCCUPIED = np.zeros((30, 40), bool)
OCCUPIED[:, 20] = True
OCCUPIED[10:20, 20] = False

REGIONS = {
    "West": {"type": "circle", "center": [0.7, 1.5], "radius": 0.5},
    "East": {"type": "rectangle", "min": [3.0, 1.0], "max": [3.9, 2.0]},
    "Hole": {"type": "polygon", "vertices": [[1.0, 0.2], [1.4, 0.2], [1.2, 0.6]]},
}
FORMULA = "F[0,30] West and F[20,40] G[0,4] East and G[0,44] not Hole"
CUSTOM = robot_from_json(
    {
        "footprint": {"radius": 0.15, "offset": [0.05, 0.0]},
        "actions": [
            {"name": "go", "translate": 0.3},
            {"name": "left", "rotate": 0.5},
            {"name": "arc", "translate": 0.2, "rotate": -0.4},
        ],
    }
)


def flat(formula=FORMULA, robot=STRETCH, origin=(-1.0, 0.5, 0.3), regions=REGIONS):
    """regions are given in the grid's frame, which the origin turns and moves."""
    grid = OccupancyGrid(OCCUPIED, 0.1, origin)
    return make_task(grid, robot, formula, {name: moved(grid, region) for name, region in regions.items()})


def moved(grid, region):
    """The region drawn in the grid's frame, in the map's; a turned rectangle is a polygon."""
    if region["type"] == "circle":
        return {**region, "center": grid.to_map(region["center"]).tolist()}
    if region["type"] == "rectangle":
        (x0, y0), (x1, y1) = region["min"], region["max"]
        region = {"type": "polygon", "vertices": [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]}
    return {**region, "vertices": grid.to_map(region["vertices"]).tolist()}


def sizes(task):
    body = make_body(task.robot, task.grid)
    return observation_size(make_rules(task), body), motion_count(body)


def random_weights(task, seed=0, units=(16, 12)):
    random = np.random.default_rng(seed)
    inputs, outputs = sizes(task)
    widths = [inputs, *units, outputs]
    shapes = [shape for i in range(3) for shape in ((widths[i], widths[i + 1]), (widths[i + 1],))]
    return {n: random.normal(0, 0.5, s).astype(np.float32) for n, s in zip(NAMES, shapes, strict=True)}


def random_policy(task, seed=0):
    network = make_network(random_weights(task, seed), *sizes(task))
    return Policy(task, make_card(task, "dqn", {}, seed, {}), network)


CRAWLER = robot_from_json(
    {
        "footprint": {"radius": 0.1},
        "actions": [
            {"name": "wait"},
            {"name": "go", "translate": 0.5},
            {"name": "left", "rotate": math.pi / 2},
            {"name": "right", "rotate": -math.pi / 2},
        ],
    }
)


def corridor(formula, robot=CRAWLER):
    """5 m long and 1.5 m wide, cells of 0.5 m, with the region End in its last metre."""
    end = {"type": "rectangle", "min": [4.0, 0.0], "max": [5.0, 1.5]}
    return make_task(OccupancyGrid(np.zeros((3, 10), bool), 0.5), robot, formula, {"End": end})


def in_state(scene, pose, status=None, run=None):
    """A robot at a pose, with this progress (by default all is pending), and what its motions lead to."""
    state = make_state(scene, observation_size(scene.rules, scene.body))
    state.status[:] = PENDING if status is None else status
    state.run[:] = 0 if run is None else run
    place(scene.rules, *pose, state)
    successors(scene.body, state.pose, state.nexts)
    return state
