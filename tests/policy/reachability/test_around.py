"""The search for a way around: what it has come to is told from what is new, however much is turned away."""

from dataclasses import replace

import numpy as np
import pytest

from evaluation.worlds.robots import ROBOTS
from specshield.caution.surprise.barred import NOTHING_BARRED, in_vain
from specshield.compiled import box
from specshield.policy.progress import PENDING, SETTLED, make_rules, pasts
from specshield.policy.reachability.around.field import NO_FIELDS, distances, goal_cells, spare_on
from specshield.policy.reachability.around.search import GAVE_UP, GRAIN, NO_WAY, POSES, go_around
from specshield.policy.reachability.policy import synthesise
from specshield.policy.reachability.tables import Guide
from specshield.policy.tree import enter, make_tree
from specshield.robot import STRETCH, robot_from_json
from specshield.robot.dynamics import make_body, simulate
from specshield.stl import robustness
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.policy.rooms import OCCUPIED, flat


def test_poses_that_are_turned_away_take_no_room_and_hide_nothing():
    random, rows = np.random.default_rng(0), 512
    tree, count = make_tree(rows + 1, 1), 0
    tree.status[:], tree.made[:] = PENDING, 0
    kept = []
    for _ in range(20 * rows):  # ten times what the table holds
        pose = random.uniform(0.0, 20.0, 3)
        tree.pose[count] = pose
        slot = enter(tree, count, GRAIN, True)
        if slot < 0:
            continue
        assert tree.table[slot] == count
        if random.random() < 0.9 or count == rows:
            tree.table[slot] = -1
        else:
            kept.append(pose)
            count += 1
    assert count > rows / 2
    assert (tree.table >= 0).sum() == count
    for pose in kept:  # none of those that were kept is new
        tree.pose[count] = pose
        assert enter(tree, count, GRAIN, True) < 0


def test_where_a_search_on_one_of_several_maps_gives_up_nothing_else_is_tried():
    """The tables know of a door to the goal, and the map has none."""
    task = flat("F[0,60] East")
    sealed = task.grid.occupied.copy()
    sealed[:, 20] = True
    body, policy = make_body(task.robot, replace(task.grid, occupied=sealed)), synthesise(task)
    history = np.array([[*task.grid.to_map([0.7, 1.5]), 0.0]])
    whole, quick = (policy.on_body(body, guess).propose(history, {}, 0.0) for guess in (False, True))
    assert (quick.motions[:, 1:] == task.robot.wait_motion).all()
    assert (whole.motions[:, 1:] != task.robot.wait_motion).any()


def test_from_off_the_map_few_poses_are_tried():
    """Each costs a hundred times what one on free floor does: a step took 9 s of a robot that was said to be
    11 m off.
    """
    task = flat("F[0,60] East")
    policy = synthesise(task).on_body(make_body(task.robot, task.grid), guess=True)
    off, beside = (np.array([[*task.grid.to_map([x, 1.5]), 0.0]]) for x in (-3.0, 0.7))
    assert (policy.propose(off, {}, 0.0).motions[:, 1:] == task.robot.wait_motion).all()
    assert (policy.propose(beside, {}, 0.0).motions[:, 1:] != task.robot.wait_motion).any()


def test_a_way_is_found_without_the_motions_that_led_nowhere():
    """From the start, nothing leads straight ahead, nor backwards, whatever the tables say."""
    task = flat("F[0,60] East")
    policy, body = synthesise(task), make_body(task.robot, task.grid)
    history = np.array([[*task.grid.to_map([0.7, 1.5]), 0.0]])
    moves = [m for m, (far, _) in enumerate(task.robot.motions) if far]
    barred = np.array([[*history[0], m, 0.01, 0.01] for m in moves])
    ways = policy.avoiding(barred).propose(history, {}, 0.0)
    poses = np.empty((*ways.motions.shape, 3))
    for motions, led in zip(ways.motions, poses, strict=True):
        simulate(body, history[0], motions, led)
    free = ~in_vain(barred, history[0], ways.motions, poses, True)
    kept = [robustness(task.formula, task.samples(np.concatenate([history, led]))) > 0 for led in poses[free]]
    assert any(kept)


def test_a_way_out_is_found_of_a_place_that_is_narrower_than_the_tables_lattice():
    """A car that cannot reverse has stood in a corner for a while, too near a wall for the tables to know
    a way out, and the turn that they would begin with leads nowhere.
    """
    occupied = np.zeros((15, 32), np.bool_)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[:5, [11, 21]] = occupied[9:, [11, 21]] = True
    actions = [
        {"name": "ahead", "translate": 0.3},
        {"name": "arc left", "translate": 0.2, "rotate": 0.35},
        {"name": "arc right", "translate": 0.2, "rotate": -0.35},
        {"name": "left", "rotate": 0.35},
        {"name": "right", "rotate": -0.35},
        {"name": "wait"},
    ]
    footprint = {"radius": 0.2, "offset": [-0.05, 0.0]}
    robot = robot_from_json({"footprint": footprint, "on_contact": "stop", "actions": actions})
    grid = OccupancyGrid(occupied, 0.25, (-1.0, -2.0, 0.0))
    goal = {"type": "rectangle", "min": [2.2, 0.6], "max": [3.8, 1.4]}
    task = make_task(grid, robot, "F[0,70] Goal", {"Goal": goal})
    history = np.tile([-0.529, -0.546, 1.603], (21, 1))
    barred = np.array([[*history[0], robot.action_names.index("right"), 0.05, 0.2]])
    ways = synthesise(task).avoiding(barred).propose(history, {}, 0.0)
    poses, body = np.empty((*ways.motions.shape, 3)), make_body(robot, grid)
    for motions, led in zip(ways.motions, poses, strict=True):
        simulate(body, history[0], motions, led)
    free = ~in_vain(barred, history[0], ways.motions, poses, True)
    samples = [task.samples(np.concatenate([history, led])) for led in poses[free]]
    assert any(robustness(task.formula, each) > 0.0 for each in samples)


TWO_DOORS = OCCUPIED.copy()
TWO_DOORS[25:, 20] = False  # a second door, at the upper end of the wall
WEST = {"type": "rectangle", "min": [0.0, 0.0], "max": [2.0, 3.0]}
EAST = {"type": "rectangle", "min": [3.0, 1.0], "max": [3.9, 2.0]}


RESTLESS = replace(STRETCH, name="restless", actions=STRETCH.actions[:4])  # ahead, right, left, back
TRAILING = ROBOTS["trailing"]


def two_rooms(formula, robot=STRETCH):
    """4 x 3 m, and the robot on the same map with the door in the middle shut."""
    grid = OccupancyGrid(TWO_DOORS, 0.1)
    task = make_task(grid, robot, formula, {"West": WEST, "East": EAST})
    shut = TWO_DOORS.copy()
    shut[10:20, 20] = True
    return task, make_body(robot, replace(grid, occupied=shut))


@pytest.mark.parametrize(
    ("robot", "guess"), [(STRETCH, False), (TRAILING, False), (RESTLESS, False), (RESTLESS, True)]
)
def test_where_a_robot_stands_is_no_use_while_another_goal_is_due_before(robot, guess):
    """It begins where it has to be from step 60 on, and has to be elsewhere by then. Neither there nor on its
    way back may it wait before the door that is shut. A robot that cannot wait turns on the spot meanwhile.
    One that cannot back out, and whose footprint trails, cannot turn any more once it has driven up to the
    door, as the tables lead it.
    """
    task, body = two_rooms("F[0,60] East and F[60,110] West", robot)
    pose = np.array([0.7, 1.5, 0.0])
    ways = synthesise(task).on_body(body, guess).propose(pose[None], {}, 0.0).motions
    best = -np.inf
    for motions in ways:
        poses = np.empty((len(motions), 3))
        simulate(body, pose, motions, poses)
        best = max(best, robustness(task.formula, task.samples(np.concatenate([pose[None], poses]))))
    assert best > 0.0


def test_a_robot_that_cannot_wait_does_not_turn_for_a_later_goal_while_another_is_due():
    task, body = two_rooms("F[0,30] West and F[60,80] West and F[0,58] East", RESTLESS)
    pose = np.array([0.7, 1.5, 0.0])
    best = -np.inf
    for motions in synthesise(task).on_body(body).propose(pose[None], {}, 0.0).motions:
        poses = np.empty((len(motions), 3))
        simulate(body, pose, motions, poses)
        best = max(best, robustness(task.formula, task.samples(np.concatenate([pose[None], poses]))))
    assert best > 0.0


def test_distances_lead_through_the_door_that_is_open():
    task, body = two_rooms("F[0,60] East and G[0,60] West")
    rules = make_rules(task)
    goals = goal_cells(body, rules)
    assert goals.shape == (2, 15, 20)
    assert (goals[0, 5:10, 15:19] > 0.0).all()
    assert (goals[0] > 0.0).sum() == 20  # cells of 20 cm whose centres lie in East
    assert (goals[1] == -np.inf).all()  # of an `always`
    fields = distances(body, goals)
    guide = Guide(body, rules, synthesise(task).tables, task.robot.wait_motion, NOTHING_BARRED)
    # From (0.7, 1.5) over the upper door, about (2.05, 2.75), to East's corner (3.1, 1.9).
    over = np.hypot(2.05 - 0.7, 2.75 - 1.5) + np.hypot(3.1 - 2.05, 2.75 - 1.9)
    status = np.array([PENDING, PENDING], np.int8)
    spare, most = spare_on(guide, fields, 0.2, 0.7, 1.5, 0.0, 10, status)
    assert spare == pytest.approx(60 - 10 - over / 0.2, abs=2.0)
    assert spare <= most < 60 - 10 - (3.0 - 0.7 - 0.109) / 0.2  # straight through the wall
    assert spare_on(guide, fields, 0.2, 3.5, 1.5, 0.0, 10, status) == (50.0, np.inf)
    status[0] = SETTLED
    assert spare_on(guide, fields, 0.2, 0.7, 1.5, 0.0, 10, status) == (np.inf, np.inf)


@pytest.mark.parametrize(("shut", "due", "found"), [(0, 60, True), (0, 12, False), (10, 60, False)])
def test_no_pose_is_tried_where_distances_show_that_a_goal_cannot_be_reached_in_time(shut, due, found):
    """The upper door leads to East in some 15 steps; where it is shut as well, nothing does. Tables for the
    map without any wall know nothing of that, and lead a search through all of the room.
    """
    task, body = two_rooms(f"F[0,{due}] East")
    occupied = body.occupied.astype(bool)
    occupied[25:, 20] = shut > 0
    body = make_body(task.robot, replace(task.grid, occupied=occupied))
    rules, wait = make_rules(task), task.robot.wait_motion
    guide = box(Guide(body, rules, synthesise(task).tables, wait, NOTHING_BARRED))
    fields = distances(body, goal_cells(body, rules))
    past = pasts(rules, np.array([[0.7, 1.5, 0.0]]), np.empty((1, 0)))[0]
    motions = np.empty((len(task.robot.motions), due), np.int64)
    poses = np.empty((*motions.shape, 3))
    most = POSES if found else 32  # enough for what is found; else it gives up
    assert (go_around(guide, 0.0, past, fields, poses, motions, most) >= 0) == found
    if not found:
        assert go_around(guide, 0.0, past, fields, poses, motions, most) == NO_WAY
        assert go_around(guide, 0.0, past, NO_FIELDS, poses, motions, most) == GAVE_UP


@pytest.mark.parametrize(
    ("rule", "least", "most"),
    [("F[0,40] Wall", [3.77, 1.0], [3.95, 2.0]), ("F[0,40] (Spot or Shelf)", [3.11, 1.51], [3.29, 1.69])],
)
def test_a_search_is_not_bounded_by_distances_to_goals_that_the_centres_of_free_cells_miss(rule, least, most):
    """At a wall the origin is in the goal, where the footprint's centre cannot be. A spot lies between the
    centres of cells, and the robot does not fit on the shelf that would do as well.
    """
    shelf = {"type": "rectangle", "min": [2.0, 0.3], "max": [2.15, 0.9]}
    goal = {"type": "rectangle", "min": least, "max": most}
    known, body = two_rooms("F[0,60] East")
    task = make_task(known.grid, STRETCH, rule, {"Wall": goal, "Spot": goal, "Shelf": shelf})
    rules = make_rules(task)
    guide = box(Guide(body, rules, synthesise(task).tables, task.robot.wait_motion, NOTHING_BARRED))
    past = pasts(rules, np.array([[0.7, 1.5, 0.0]]), np.empty((1, 0)))[0]
    motions = np.empty((len(task.robot.motions), 40), np.int64)
    fields, poses = distances(body, goal_cells(body, rules)), np.empty((*motions.shape, 3))
    assert go_around(guide, 0.0, past, fields, poses, motions, POSES) != NO_WAY
