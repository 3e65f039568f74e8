"""The training environment: episodes that begin in their middle, and steps that are f."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from specshield.errors import MapError
from specshield.policy.dqn.environment import Environment, begin_episode, free_poses
from specshield.policy.dqn.scene import make_scene
from specshield.policy.progress import ALWAYS, BROKEN, PENDING, SETTLED
from specshield.robot import STRETCH
from specshield.robot.dynamics import in_collision, make_body, step
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.policy.rooms import CRAWLER, CUSTOM, corridor, flat, in_state

BOTH = pytest.mark.parametrize("robot", [STRETCH, CUSTOM], ids=["stretch", "custom"])


def begun(t, chance, pose=(1.25, 0.75, 0.0)):
    """F[0,4] is over at step 5, G[0,20] lasts, and F[8,12] G[2,4] may settle from step 9 to 16."""
    scene = make_scene(corridor("F[0,4] End and G[0,20] y < 1.0 and F[8,12] G[2,4] End"))
    state = in_state(scene, pose, status=[BROKEN] * 3, run=[7] * 3)
    begin_episode(scene.rules, t, np.full(3, chance), state)
    assert state.run.tolist() == [0, 0, 0]
    return state.status.tolist()


def test_an_episode_that_begins_in_its_middle_by_hand():
    assert begun(0, 0.0) == [PENDING, PENDING, PENDING]
    assert begun(3, 0.49) == [SETTLED, PENDING, PENDING]  # 3/5 of its window is over
    assert begun(3, 0.61) == [PENDING, PENDING, PENDING]
    assert begun(1, 0.49) == [SETTLED, PENDING, PENDING]  # 1/5 is over, but half is the least
    assert begun(1, 0.51) == [PENDING, PENDING, PENDING]
    assert begun(8, 0.99) == [SETTLED, PENDING, PENDING]
    assert begun(14, 0.66) == [SETTLED, PENDING, SETTLED]  # 6/9
    assert begun(14, 0.67)[:2] == [SETTLED, PENDING]
    assert begun(10, 0.9, pose=(1.25, 1.25, 0.0)) == [SETTLED, BROKEN, PENDING]  # x_t counts


@BOTH
def test_progress_is_consistent_in_every_episode(robot):
    task = flat(robot=robot)
    environment, random = Environment(task, 128, seed=1), np.random.default_rng(1)
    rules, begun_late = environment.scene.rules, 0
    for _ in range(100):
        _, ended = environment.step(random.integers(0, len(robot.motions), 128))
        robots = environment.robots
        running = robots.t < task.horizon
        assert (robots.status[running] != BROKEN).all()
        over = rules.last[None] <= robots.t[running, None]
        assert (robots.status[running][over] == SETTLED).all()
        soon = (rules.kind == ALWAYS)[None] & ~over
        assert (robots.status[running][soon] == PENDING).all()
        begun_late += np.sum(ended & running & (robots.t > 0))
    assert begun_late > 50


@BOTH
def test_observations_are_finite_and_bounded(robot):
    environment, random = Environment(flat(robot=robot), 128, seed=1), np.random.default_rng(1)
    least, most = np.inf, -np.inf
    for _ in range(150):
        environment.step(random.integers(0, len(robot.motions), 128))
        observations = environment.robots.observation
        assert np.isfinite(observations).all()
        least, most = min(least, observations.min()), max(most, observations.max())
    assert -2.0 <= least < most <= 2.5


def test_a_step_is_f():
    environment = Environment(flat(robot=CUSTOM), 16, seed=0)
    before, motions = environment.robots.pose.copy(), np.arange(16) % 3
    _, ended = environment.step(motions)
    for i in np.flatnonzero(~ended):
        assert tuple(environment.robots.pose[i]) == step(environment.scene.body, *before[i], motions[i])


def test_an_episode_ends_at_the_horizon():
    task = corridor("F[0,3] End")
    environment = Environment(task, 8, seed=0)
    for _ in range(20):
        before = environment.robots.t.copy()
        _, ended = environment.step(np.zeros(8, np.int64))
        assert (ended == (before + 1 >= 3)).all()
        assert (environment.robots.t[~ended] == before[~ended] + 1).all()


def test_free_poses_are_free_and_spread():
    task = flat()
    body = make_body(task.robot, task.grid)
    poses = free_poses(task, body, 2000, np.random.default_rng(0))
    assert not any(in_collision(body, *pose) for pose in poses)
    u = task.grid.to_grid(poses[:, :2])[:, 0]
    assert 0.4 < np.mean(u < 2.0) < 0.6
    assert abs(np.mean(poses[:, 2])) < 0.2


def test_free_poses_have_their_origin_on_the_map_also_where_the_footprint_lies_beside_it():
    grid = OccupancyGrid(np.zeros((8, 6), bool), 0.25, (0.0, 0.0, 0.8))
    robot = replace(STRETCH, radius=0.1, offset=(0.3, 0.0))
    task = make_task(grid, robot, "F[0,3] x > 1")
    poses = free_poses(task, make_body(robot, grid), 2000, np.random.default_rng(0))
    assert grid.holds(poses[:, :2]).all()


def test_a_map_without_free_space_is_refused():
    task = make_task(OccupancyGrid(np.ones((2, 2), bool), 0.1), CRAWLER, "F[0,3] x > 0")
    with pytest.raises(MapError) as caught:
        free_poses(task, make_body(CRAWLER, task.grid), 1, np.random.default_rng(0))
    assert caught.value.path == "map"
