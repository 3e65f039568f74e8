import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import label

from evaluation import disturbance
from specshield.errors import NotFound
from specshield.robot import STRETCH
from specshield.robot.dynamics import in_collision, step
from specshield.sim.cases import load_case

AHEAD = 0  # the Stretch's first motion


@pytest.fixture(scope="module")
def case():
    return load_case("case1")


def ends(name, case, before, n=4000):
    after = step(case.body, *before, AHEAD)
    random = np.random.default_rng(1)
    poses = [disturbance.executed(name, case.body, before, after, random) for _ in range(n)]
    return np.array(after), np.array(poses)


def test_gaussian_noise_has_the_constants_it_says(case):
    after, poses = ends("gaussian", case, (4.5, 5.0, 0.3))
    errors = (poses - after) / (0.01, 0.01, math.radians(0.5))
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=4 / math.sqrt(len(errors)))
    np.testing.assert_allclose(errors.std(axis=0), 1.0, atol=4 / math.sqrt(2 * len(errors)))
    assert np.abs(np.corrcoef(errors.T) - np.eye(3)).max() < 4 / math.sqrt(len(errors))


def test_one_motion_in_twenty_slips(case):
    before = (4.5, 5.0, 0.3)
    after, poses = ends("slip", case, before)
    stayed = (poses == before).all(axis=1)
    assert stayed.mean() == pytest.approx(0.05, abs=4 * math.sqrt(0.05 * 0.95 / len(poses)))
    assert (poses[~stayed] == after).all()


def test_short_strides_go_nine_tenths_of_their_way(case):
    before = (4.5, 5.0, 0.3)
    after, poses = ends("short", case, before, 2)
    for pose in poses:
        np.testing.assert_allclose(pose - before, [0.9, 0.9, 1.0] * (after - before), atol=1e-12)


@pytest.mark.parametrize("name", disturbance.DISTURBANCES)
def test_standing_still_is_never_disturbed(case, name):
    pose, random = (4.5, 5.0, 0.3), np.random.default_rng(0)
    assert all(disturbance.executed(name, case.body, pose, pose, random) == pose for _ in range(200))


def test_no_noise_takes_a_robot_through_a_wall(case):
    """Up against it, half of the noise would; the robot is then where f leads."""
    against = (4.5, 5.0, math.pi / 2)
    for _ in range(10):
        against = step(case.body, *against, AHEAD)
    before = (against[0], against[1] - 0.1, against[2])
    after, poses = ends("gaussian", case, before, 1000)
    assert not any(in_collision(case.body, *pose) for pose in poses)
    held = (poses == after).all(axis=1).mean()
    assert 0.3 < held < 0.7
    assert in_collision(case.body, after[0], after[1] + 0.02, after[2])


def test_a_shifted_world_is_off_by_five_centimetres_and_the_rule_is_not(case):
    origins = set()
    for seed in range(20):
        world = disturbance.world("shift", case, None, np.random.default_rng(seed))
        origins.add(tuple(np.round(np.subtract(world.task.grid.origin, case.task.grid.origin), 6)))
        assert world.task.regions == case.task.regions
        assert np.array_equal(world.task.grid.occupied, case.task.grid.occupied)
    assert origins == {(0.05, 0.0, 0.0), (-0.05, 0.0, 0.0), (0.0, 0.05, 0.0), (0.0, -0.05, 0.0)}


def test_an_obstacle_stands_on_the_way_and_cuts_nothing_off(case):
    way = np.linspace((0.9, 5.0, 0.0), (9.0, 5.0, 0.0), 60)
    for seed in range(5):
        world = disturbance.world("obstacle", case, lambda: way, np.random.default_rng(seed))
        added = world.task.grid.occupied & ~case.task.grid.occupied
        places = case.task.grid.centres[added]
        middle = places.mean(axis=0)
        assert np.hypot(*(way[:, :2] - middle).T).min() < 0.1
        assert np.hypot(*(middle - way[0, :2])) > disturbance.AWAY - 0.05
        assert np.ptp(places, axis=0) == pytest.approx([0.25, 0.25], abs=0.051)  # between cell centres
        pieces = [label(c.task.grid.clearance > disturbance.PASSABLE)[1] for c in (case, world)]
        assert pieces[0] == pieces[1]
    nowhere = disturbance.world("obstacle", case, lambda: way[:3], np.random.default_rng(0))
    assert nowhere.task.grid == case.task.grid


def test_the_collider_is_off_centre_in_the_world_alone(case):
    told = disturbance.believed("collider", case.task)
    assert told.robot == replace(STRETCH, offset=(0.0, 0.0))
    assert disturbance.world("collider", case, None, np.random.default_rng(0)).task.robot is STRETCH
    assert disturbance.believed("gaussian", case.task) is case.task


def test_an_unknown_noise_is_told_with_those_there_are():
    with pytest.raises(NotFound) as caught:
        disturbance.check("fog")
    assert "gaussian" in caught.value.expected
