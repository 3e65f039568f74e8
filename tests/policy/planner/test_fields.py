"""Fields of steps to go against a breadth-first search on whole cells, and counted by hand."""

import math

import numpy as np
import pytest

from specshield.policy.planner.fields import OUT_OF_REACH, to_go_after, to_go_at
from tests.oracles.cells import FORWARD, LEFT, MOTIONS, RIGHT, STATES, WAIT, WALLS
from tests.policy.planner.worlds import cells_of, literal_of, plan_from

EAST, NORTH, WEST, SOUTH = range(4)


@pytest.fixture(scope="module")
def leading():
    """Cells, world and the field that leads to B, which lies behind the corner of a wall."""
    cells = cells_of("F[0,9] B")
    world, _, _ = plan_from(cells, (0, 0, NORTH))
    return cells, world, int(world.field[literal_of(cells, "B", 1), 0])


def steps_by_search(cells, goal):
    """The fewest motions from each state into a cell."""
    steps = np.array([0.0 if state[:2] == goal else np.inf for state in STATES])
    for _ in range(len(STATES)):
        steps = np.minimum(steps, 1.0 + steps[cells.table].min(axis=1))
    return steps


def test_steps_to_go_are_those_of_a_search_of_every_state(leading):
    cells, world, f = leading
    for state, steps in zip(STATES, steps_by_search(cells, (2, 1)), strict=True):
        if WALLS[state[1]][state[0]] != "#":
            x, y, theta = cells.pose(*state)
            assert to_go_at(cells.body, world.fields, f, x, y, theta) == pytest.approx(steps, abs=0.02)


def test_a_field_goes_round_the_corner(leading):
    """From the cell beside the wall, facing it: back, round its end and up, with three turns."""
    cells, world, f = leading
    # Two cells ahead, a turn, one cell ahead.
    assert to_go_at(cells.body, world.fields, f, *cells.pose(0, 0, EAST)) == 4.0
    assert to_go_at(cells.body, world.fields, f, *cells.pose(0, 1, EAST)) == 7.0


def test_steps_to_go_between_the_crossings_are_linear(leading):
    cells, world, f = leading
    x, y, theta = cells.pose(0, 0, EAST)
    assert to_go_at(cells.body, world.fields, f, x + 0.05, y, theta) == pytest.approx(3.75)


def test_steps_to_go_after_each_motion(leading):
    """Standing still leads nowhere, and neither does what undoes the motion before."""
    cells, world, f = leading
    out = np.empty(MOTIONS)
    to_go_after(cells.body, world.fields, f, *cells.pose(0, 0, EAST), -1, out)
    assert out[[FORWARD, LEFT, RIGHT]].tolist() == [3.0, 5.0, 5.0]
    assert out[WAIT] == math.inf
    to_go_after(cells.body, world.fields, f, *cells.pose(0, 0, EAST), RIGHT, out)
    assert out[LEFT] == math.inf
    assert out[RIGHT] == 5.0


def test_what_cannot_be_reached_is_out_of_reach():
    """B lies off the map, and not right beside it: what the lattice just misses counts as narrow."""
    cells = cells_of("F[0,9] B", places={"B": (7, 0)})
    world, _, _ = plan_from(cells, (0, 0, NORTH))
    f = int(world.field[literal_of(cells, "B", 1), 0])
    assert to_go_at(cells.body, world.fields, f, *cells.pose(0, 0, NORTH)) >= OUT_OF_REACH


def test_a_field_that_keeps_to_what_has_to_hold_goes_round_it():
    """C lies on the straight way up to A: round it there and back, with four turns."""
    cells = cells_of("F[0,14] A and G[0,14] not C")
    world, _, _ = plan_from(cells, (0, 0, NORTH))
    free, keeping = world.field[literal_of(cells, "A", 1)]
    pose = cells.pose(0, 1, NORTH)
    assert free == keeping  # `not C` holds at every step: all ways keep to it
    assert to_go_at(cells.body, world.fields, int(keeping), *pose) == steps_round_c(cells)


def steps_round_c(cells):
    """The fewest motions from (0, 1), facing north, to A at (0, 4) without entering C at (0, 2)."""
    steps = np.array([0.0 if state[:2] == (0, 4) else np.inf for state in STATES])
    barred = np.array([state[:2] == (0, 2) for state in STATES])
    for _ in range(len(STATES)):
        steps = np.where(barred, np.inf, np.minimum(steps, 1.0 + steps[cells.table].min(axis=1)))
    return steps[STATES.index((0, 1, NORTH))]
