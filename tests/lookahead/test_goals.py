"""Goals and ways in a room with a wall across it, by hand."""

import math

import numpy as np
import pytest

from specshield.lookahead.goals import NO_PATH, UNIT, cell_of, make_goals
from specshield.robot import robot_from_json
from specshield.robot.dynamics import make_body
from specshield.world.occupancy import OccupancyGrid

POINT = robot_from_json({"footprint": {"radius": 0.01}, "actions": [{"name": "go", "translate": 0.1}]})


def room(door):
    """1 m by 2 m in cells of 0.1 m, a wall across the middle with a door at one side, or none."""
    occupied = np.zeros((10, 20), bool)
    occupied[: 9 if door else 10, 10] = True
    grid = OccupancyGrid(occupied, 0.1)
    body = make_body(POINT, grid)
    return body, make_goals(body, grid)


def test_there_is_a_goal_in_each_square_of_half_a_metre():
    _, goals = room(door=True)
    cells = [tuple(np.argwhere(distance == 0)[0].tolist()) for distance in goals.distance]
    assert goals.pitch == 0.1
    assert cells == [(j, i) for j in (2, 7) for i in (2, 7, 12, 17)]
    assert [cell_of(goals, 0.1 * (i + 0.5), 0.1 * (j + 0.5)) for j, i in cells] == cells
    assert cell_of(goals, -3.0, 9.0) == (9, 0)  # the nearest to a point outside


def test_distances_and_ways_go_through_the_door():
    """From the lower left square to the lower right one: up to the door, through it, and down again."""
    _, goals = room(door=True)
    through = math.hypot(8, 7) + math.hypot(2, 7)  # in cells: (2, 2) to the door at (9, 10), to (2, 12)
    assert 10 * through <= goals.distance[2, 2, 2] <= 10 * 1.1 * through + 20
    du, dv = goals.way[2, 2, 2]  # towards the door: up and to the right
    assert du > 0
    assert dv > 0
    assert math.hypot(du, dv) / UNIT == pytest.approx(1.0, abs=0.02)
    assert goals.way[0, 2, 2].tolist() == [0, 0]  # at the goal
    assert goals.way[0, 2, 7].tolist() == [-UNIT, 0]  # straight back to it


def test_behind_a_wall_without_a_door_there_is_no_path():
    _, goals = room(door=False)
    assert goals.distance[0, 2, 12] == NO_PATH
    assert goals.distance[0, 2, 7] == 50
