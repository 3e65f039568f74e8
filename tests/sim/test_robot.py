import math
from dataclasses import replace

import numpy as np
import pytest

from specshield.policy.dqn.environment import free_poses
from specshield.robot import STRETCH
from specshield.robot.dynamics import in_collision
from specshield.sim.cases import load_case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import SimulatedRobot, waypoints

A = {name: i for i, name in enumerate(STRETCH.action_names)}


def test_it_executes_what_the_actions_say(case):
    x, y = (5.0, 5.0) if case.name == "case1" else (5.0, 4.7)
    robot = SimulatedRobot(case, (x, y, 0.0))
    turned = math.radians(24)
    for name, expected in [
        ("m", (x + 0.2, y, 0.0)),
        ("l", (x + 0.2, y, math.pi / 6)),
        ("rs", (x + 0.2, y, turned)),
        ("end", (x + 0.2, y, turned)),
        ("b", (x + 0.2 - 0.2 * math.cos(turned), y - 0.2 * math.sin(turned), math.radians(24))),
        ("sub_done", None),
    ]:
        before = robot.pose
        robot.execute(A[name])
        assert robot.pose == pytest.approx(expected or before, abs=1e-12)
        assert robot.observe().last_action == A[name]


def test_it_senses_what_would_stop_it(case):
    start = next(
        pose
        for pose in free_poses(case.task, case.body, 5000, np.random.default_rng(0)).tolist()
        if SimulatedRobot(case, tuple(pose)).observe().blocked[A["m"]]
    )
    robot = SimulatedRobot(case, tuple(start))
    for _ in range(3):
        robot.execute(A["m"])
    assert math.dist(robot.pose[:2], start[:2]) < 0.1
    assert not in_collision(case.body, *robot.pose)
    assert not robot.observe().blocked[[A["end"], A["p"], A["d"]]].any()


def test_the_way_leads_to_the_target_from_every_free_cell(case):
    grid, following = case.task.grid, waypoints(case)
    points = grid.centres[~grid.occupied]
    for _ in range(80):  # of half a metre
        cells = np.floor(grid.to_grid(points) / grid.resolution).astype(int)
        points = following[cells[:, 1], cells[:, 0]]
        assert not grid.occupied[cells[:, 1], cells[:, 0]].any()
    assert np.hypot(*(points - case.target).T).max() < 0.05


def test_a_target_beside_a_wall_is_led_to_as_well(case):
    grid = case.task.grid
    i, j = np.argwhere(~grid.occupied & (grid.clearance < 0.08))[0]
    target = grid.centres[i, j]
    points, following = grid.centres[~grid.occupied], waypoints(replace(case, target=tuple(target)))
    for _ in range(80):
        cells = np.floor(grid.to_grid(points) / grid.resolution).astype(int)
        points = following[cells[:, 1], cells[:, 0]]
    assert np.hypot(*(points - target).T).max() < 0.05


def test_at_the_target_is_a_metre_along_free_space(case):
    x, y = case.target
    assert SimulatedRobot(case, (x - 0.9, y, 0.0)).at_target
    assert not SimulatedRobot(case, (x - 1.1, y, 0.0)).at_target
    observation = SimulatedRobot(case, (x - 0.8, y, math.pi / 2)).observe()
    assert observation.distance == pytest.approx(0.8, abs=0.06)
    assert observation.bearing == pytest.approx(-math.pi / 2, abs=0.1)


def test_a_target_with_little_room_around_it_is_reached():
    case, random = replace(load_case("case1"), target=(8.9, 5.57)), np.random.default_rng(0)
    for start in ((4.5, 5.0, 0.0), (2.0, 5.0, 1.0), (8.7, 1.3, 2.0)):
        robot, model = SimulatedRobot(case, start), GoalSeeker(case.task.robot)
        for _ in range(300):
            logits = model.logits(robot)
            robot.execute(int(random.choice(len(logits), p=np.exp(logits) / np.exp(logits).sum())))
        assert robot.at_target
