"""Going down a field by hand: a corridor, one to wait in, one step of a beam."""

import math
from contextlib import nullcontext

import numpy as np
import pytest

from specshield.episode import make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.planner.approach import _insert, descend, descend_by_beam
from specshield.policy.planner.policy import synthesise
from specshield.policy.planner.way import BEGIN, UNTIL, keeps, stay
from specshield.robot import robot_from_json
from specshield.robot.dynamics import make_body, simulate
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.cells import FORWARD, LEFT, RIGHT, WAIT
from tests.policy.planner.worlds import cells_of, literal_of, nothing_needed, plan_from

EAST, NORTH, WEST, SOUTH = range(4)


@pytest.fixture(scope="module")
def corridor():
    """Four cells south of A, facing it; C is between."""
    cells = cells_of("F[0,14] A and F[0,14] C")
    return cells, *plan_from(cells, (0, 0, NORTH))[:2]


def test_a_descent_of_a_corridor_goes_straight_on(corridor):
    cells, world, way = corridor
    k = literal_of(cells, "A", 1)
    n = descend(world, way, k, world.field[k, 0], True, 0, 14, nothing_needed(world))
    assert n == 4
    assert way.motions[:4].tolist() == [FORWARD] * 4
    np.testing.assert_allclose(way.poses[:5], [cells.pose(0, j, NORTH) for j in range(5)], atol=1e-9)
    leaf = world.literals.formula.tree.leaf_at[0]
    assert (way.known[leaf + 1 : leaf + 5] > 0.0).tolist() == [False, False, False, True]


def test_a_descent_that_may_wait_waits_for_what_has_to_hold():
    """C may be entered at step 4 at the earliest, and is next to where the robot is at step 1."""
    cells = cells_of("F[0,14] A and F[0,14] not C")
    world, way, _ = plan_from(cells, (0, 0, NORTH))
    k, need = literal_of(cells, "A", 1), nothing_needed(world)
    need[literal_of(cells, "C", -1), [BEGIN, UNTIL]] = 1, 3
    assert descend(world, way, k, world.field[k, 0], True, 0, 14, need) == 6
    assert way.motions[:6].tolist() == [FORWARD, WAIT, WAIT, FORWARD, FORWARD, FORWARD]
    assert descend(world, way, k, world.field[k, 0], True, 0, 5, need) == -1  # too late


@pytest.mark.parametrize("stride", [0.02, 0.01, 0.002])
def test_a_robot_with_small_strides_gets_there(stride):
    """Straight on, to the last step that its strides take; one step less is too late."""
    strides = round(0.3 / stride)
    robot = robot_from_json(
        {"footprint": {"radius": 0.1}, "actions": [{"name": "go", "translate": stride}, {"name": "wait"}]}
    )
    for steps, kept in ((strides + 1, True), (strides, False)):
        grid = OccupancyGrid(np.zeros((20, 20), bool), 0.1)
        task = make_task(grid, robot, f"F[0,{steps}] y > {0.5 + (strides + 0.5) * stride}")
        shield = make_shield([synthesise(task)])
        with nullcontext() if kept else pytest.raises(InfeasibleStart):
            start(shield, (1.0, 0.5, math.pi / 2))


@pytest.mark.parametrize("heading", [-math.pi / 2, 0.0, math.pi / 2])
def test_a_robot_whose_strides_skip_every_other_cell_gets_there(heading):
    """It turns by 90 degrees alone, and stands between the cells from which a way leads and those from which
    none does.
    """
    turns = [{"name": "left", "rotate": math.pi / 2}, {"name": "right", "rotate": -math.pi / 2}]
    actions = [{"name": "go", "translate": 0.2}, *turns, {"name": "wait"}]
    robot = robot_from_json({"footprint": {"radius": 0.09}, "actions": actions})
    goal = {"A": {"type": "circle", "center": [0.3, 0.1], "radius": 0.09}}
    task = make_task(OccupancyGrid(np.zeros((4, 4), bool), 0.2), robot, "F[0,10] A", goal)
    plan = synthesise(task).propose(np.array([[0.3, 0.5, heading]]), {}, 0.0)
    (way,) = plan.motions[plan.motions[:, 0] == plan.preferred]
    poses = np.empty((len(way), 3))
    simulate(make_body(robot, task.grid), np.array([0.3, 0.5, heading]), way, poses)
    assert np.hypot(poses[:, 0] - 0.3, poses[:, 1] - 0.1).min() < 0.09


def test_what_has_to_hold_is_asked_for_in_its_steps_alone(corridor):
    cells, world, _ = corridor
    goal, k, need = literal_of(cells, "A", 1), literal_of(cells, "C", 1), nothing_needed(world)
    need[k, [BEGIN, UNTIL]] = 2, 3
    outside = np.array([-1.0, -1.0])  # neither in A nor in C
    assert [keeps(world, goal, at, need, outside) for at in range(1, 5)] == [True, False, False, True]


def test_one_step_of_a_beam_keeps_the_poses_by_their_steps_to_go(corridor):
    cells, world, way = corridor
    k = literal_of(cells, "A", 1)
    n = descend_by_beam(world, way, k, world.field[k, 0], 0, 14, np.inf, (1, 1), nothing_needed(world))
    assert n == 1
    assert way.motions[0] == FORWARD
    assert way.places[1, :3, 3].tolist() == [3.0, 5.0, 5.0]  # ahead; a turn, which has to be turned back
    assert way.trail[1, :3].tolist() == [[0, FORWARD], [0, LEFT], [0, RIGHT]]


def test_a_beam_arrives_where_the_literal_holds(corridor):
    cells, world, way = corridor
    k = literal_of(cells, "A", 1)
    assert descend_by_beam(world, way, k, world.field[k, 0], 0, 14, 0.0, (0, 14), nothing_needed(world)) == 4
    assert way.motions[:4].tolist() == [FORWARD] * 4
    assert descend_by_beam(world, way, k, world.field[k, 0], 0, 3, 0.0, (0, 14), nothing_needed(world)) == -1


def test_a_beam_keeps_one_of_two_poses_that_are_alike():
    places, trail = np.zeros((12, 4)), np.zeros((12, 2), np.int64)
    kept = _insert(places, trail, 0, (1.0, 1.0, 0.0, 5.0), (0, 3))
    kept = _insert(places, trail, kept, (2.0, 1.0, 0.0, 4.0), (1, 2))  # nearer: goes first
    kept = _insert(places, trail, kept, (1.0, 1.01, 0.0, 1.0), (2, 1))  # like the first one
    assert kept == 2
    assert places[:2].tolist() == [[2.0, 1.0, 0.0, 4.0], [1.0, 1.0, 0.0, 5.0]]
    assert trail[:2].tolist() == [[1, 2], [0, 3]]


def test_staying_fills_the_way(corridor):
    cells, world, way = corridor
    stay(world, way, 0, 14)
    assert way.motions.tolist() == [WAIT] * 14
    assert np.all(way.poses == cells.pose(0, 0, NORTH))
