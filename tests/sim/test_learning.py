"""What the model is trained from: apartments, the expert, practice; and a training in small."""

import numpy as np
import pytest
from scipy.ndimage import label

from specshield.sim.learned.expert import END, IDLE
from specshield.sim.learned.floor_plans import HABITS, random_house
from specshield.sim.learned.network import KINDS
from specshield.sim.learned.practice import Practice, make_apartments, sample
from specshield.sim.learned.train import Settings, train
from specshield.sim.learned.transformer import export, restore


@pytest.fixture(scope="module")
def houses():
    random = np.random.default_rng(0)
    return [random_house(random) for _ in range(6)]


def test_apartments_have_targets_where_a_robot_can_go(houses):
    assert set(HABITS) == set(KINDS)
    for house in houses:
        grid = house.grid
        parts, _ = label(grid.clearance > 0.32)
        cells = [
            tuple(np.floor(np.array(point)[::-1] / grid.resolution).astype(int))
            for point in house.targets.values()
        ]
        assert len({parts[cell] for cell in cells} | {0}) == 2
        assert "bowl" in house.targets
    assert len({house.grid.content_hash for house in houses}) == len(houses)


def test_the_expert_finds_every_target_and_its_distribution_is_spread(houses):
    random = np.random.default_rng(1)
    practice = Practice(make_apartments(houses), 40, random)
    practice.reset([1.0] * len(KINDS))
    practice.held[:] = practice.steered[:] = False
    practice.slips[:] = 0.0
    for _ in range(400):
        assert practice.advice.sum(axis=1) == pytest.approx(1.0, abs=1e-5)
        assert np.delete(practice.advice, END, axis=1).min() > 1e-5
        practice.execute(sample(practice.advice, random))
        near = np.hypot(
            *(practice.pose[:, :2] - practice.apartments.targets[practice.house, practice.kind]).T
        )
        assert (near[practice.done] < 0.75).all()
    assert practice.done.mean() >= 0.95


def test_interference_overrules_the_robot(houses):
    practice = Practice(make_apartments(houses), 40, np.random.default_rng(2))
    practice.reset([1.0] * len(KINDS))
    practice.held[:], practice.steered[:], practice.slips[:] = True, False, 0.0
    practice.begin[:], practice.length[:] = 0, 5
    before = practice.pose.copy()
    for _ in range(5):
        practice.execute(np.full(40, 1))
        assert (practice.last == IDLE).all()
    assert np.array_equal(practice.pose, before)
    practice.execute(np.full(40, 1))
    assert (practice.last == 1).all()


def test_a_training_learns_and_its_seed_decides_it(houses):
    settings, losses = Settings(houses=1, rounds=6, robots=16, steps=24, recent=2), []
    first = export(train(settings, 0, houses, lambda report: losses.append(report.loss)))
    assert losses[-1] < 0.8 * losses[0]
    again = export(train(settings, 0, houses, lambda report: None))
    assert all(np.array_equal(first[name], again[name]) for name in first)
    restored = export(restore(first))
    assert all(np.array_equal(first[name], restored[name]) for name in first)
