"""The base that MuJoCo simulates does about what f says, and does not go through walls."""

from __future__ import annotations

import math

import numpy as np
import pytest

from specshield.robot.dynamics import step
from specshield.sim.cases import load_case

pytest.importorskip("mujoco")


def test_in_the_open_it_does_what_f_says_within_the_noise_that_is_assumed():
    from evaluation.worlds.wheels import WheeledRobot

    case = load_case("case1")
    robot = WheeledRobot(case, (4.5, 5.0, 0.3), np.random.default_rng(0))
    for name in ("m", "l", "m", "rs", "b", "r", "ls"):
        action = case.task.robot.action_names.index(name)
        x, y, theta = step(case.body, *robot.pose, case.task.robot.motion_of[action])
        robot.execute(action)
        after = robot.pose
        assert 0.0 < math.hypot(after[0] - x, after[1] - y) < 0.01, name
        assert abs(math.remainder(after[2] - theta, 2 * math.pi)) < math.radians(1.0), name
        assert not robot.touches


def test_a_wall_stops_it_and_its_scanner_sees_the_wall():
    from evaluation.worlds.wheels import WheeledRobot

    case = load_case("case1")
    robot = WheeledRobot(case, (4.5, 5.0, 0.3), np.random.default_rng(0))
    ahead = case.task.robot.action_names.index("m")
    for _ in range(60):
        robot.execute(ahead)
    occupied, free = robot.look()
    grid = case.task.grid
    assert robot.touches
    assert not grid.occupied[case.cell(robot.pose)]
    assert np.mean([grid.occupied[case.cell(point)] for point in occupied.tolist()]) > 0.95
    assert np.mean([grid.occupied[case.cell(point)] for point in free.tolist()]) < 0.02
