"""Feasibility step by step: the progress as a number, how a step changes it, and a corridor by hand."""

from __future__ import annotations

import math

import numpy as np

from specshield.episode import decide, make_shield
from specshield.policy.lattice import holds_at, make_lattice
from specshield.policy.progress import make_rules
from specshield.policy.reachability.policy import synthesise
from specshield.policy.reachability.stepwise import (
    BROKEN_STATE,
    digits_of,
    feasible_steps,
    state_count,
    transitions,
)
from specshield.robot import robot_from_json
from specshield.robot.dynamics import make_body
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.cells import CELL
from tests.policy.reachability.corridor import EAST, NORTH, RESTLESS, make_corridor


def test_the_digits_of_the_progress():
    """A dwell of three steps has the digits 0 to 4, a visit 0 and 1, an `always` none."""
    rules = make_rules(make_corridor("F[0,4] G[0,2] A and F[0,8] B and G[0,8] not C", A=1, B=5, C=0))
    stride, dwell = digits_of(rules)
    assert stride.tolist() == [1, 5, 0]
    assert dwell.tolist() == [3, 0, 0]
    assert state_count(rules) == 10


def after_each(formula, t, holds):
    """The progress after step t, by that before it, where A holds (1) or does not (0)."""
    rules = make_rules(make_corridor(formula, RESTLESS, A=1))
    return transitions(rules, *digits_of(rules), state_count(rules), t, holds)


def test_how_a_visit_changes():
    assert after_each("F[2,4] A", 1, 1).tolist() == [0, 1]  # too soon
    assert after_each("F[2,4] A", 2, 1).tolist() == [1, 1]
    assert after_each("F[2,4] A", 2, 0).tolist() == [0, 1]
    assert after_each("F[2,4] A", 4, 0).tolist() == [BROKEN_STATE, 1]  # too late


def test_how_a_dwell_changes():
    """F[0,2] G[0,1] A: two steps in A, begun by step 2; digits 0, 1, 2, and 3 once settled."""
    assert after_each("F[0,2] G[0,1] A", 0, 1)[[0, 3]].tolist() == [1, 3]
    assert after_each("F[0,2] G[0,1] A", 1, 1)[[0, 1, 3]].tolist() == [1, 3, 3]
    assert after_each("F[0,2] G[0,1] A", 2, 0)[[0, 1, 3]].tolist() == [BROKEN_STATE, BROKEN_STATE, 3]


def test_the_steps_at_which_a_corridor_is_feasible():
    """In A at step 2 or 3, by a robot that goes and turns; while it turns in A, it is still there."""
    task = make_corridor("F[2,3] A", RESTLESS, A=4)
    body, rules = make_body(task.robot, task.grid), make_rules(task)
    lattice = make_lattice(body, CELL)
    row = np.arange(6, dtype=np.int32).reshape(1, 6)
    bits = feasible_steps(lattice, rules, holds_at(body, rules, lattice), 3, row)
    pending = bits[..., 0] & 1  # [t, cell, heading]
    assert not pending[3].any()  # too late
    assert pending[2, :, EAST].tolist() == [0, 0, 0, 1, 1, 0]
    assert pending[2, :, NORTH].tolist() == [0, 0, 0, 0, 1, 0]
    assert pending[1, :, EAST].tolist() == [0, 0, 1, 1, 1, 0]
    assert pending[1, :, NORTH].tolist() == [0, 0, 0, 1, 1, 1]  # a turn, then a move
    assert pending[0, :, EAST].tolist() == [0, 1, 1, 1, 1, 1]  # the last by two turns and a move


def test_a_robot_of_many_motions_that_cannot_wait_keeps_most_of_them():
    """40 motions, of which each step of a search looks at 14: first of all motions a way is looked for after
    few, and after all only where that finds none.
    """
    actions = [
        {"name": f"a{i}{j}", "translate": 0.05 * i, "rotate": math.radians(9.0 * (j - 4.5))}
        for i in range(4)
        for j in range(10)
    ]
    robot = robot_from_json({"footprint": {"radius": 0.1}, "actions": actions})
    grid = OccupancyGrid(np.zeros((40, 40), np.bool_), 0.1)
    rule, regions = "F[0,25] A and F[30,50] B", {}
    for name, x in (("A", 0.8), ("B", 3.2)):
        regions[name] = {"type": "circle", "center": [x, x], "radius": 0.4}
    shield = make_shield([synthesise(make_task(grid, robot, rule, regions))])
    rng, kept = np.random.default_rng(0), []
    for _ in range(6):
        x, y = rng.uniform(0.8, 3.2, 2)
        found = decide(shield, [[x, y, rng.uniform(-np.pi, np.pi)]], np.zeros(40))
        kept.append(sum(value == 1.0 for value in found.j_values))
    assert min(kept) >= 36, kept
