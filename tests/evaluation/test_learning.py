"""What the model is trained from: apartments, the expert, practice; and a training in small."""

import numpy as np
import pytest
from scipy.ndimage import label

from evaluation.model.expert import END, IDLE
from evaluation.model.floor_plans import HABITS, random_house
from evaluation.model.practice import Practice, make_apartments, sample
from evaluation.model.train import ALONE, Settings, practise, train
from evaluation.model.transformer import Transformer, export, restore
from specshield.sim.learned.network import KINDS


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


def test_without_interference_only_its_own_choice_is_executed(houses):
    practice = Practice(make_apartments(houses), 40, np.random.default_rng(2), interference=False)
    practice.reset([1.0] * len(KINDS))
    for wish in (1, 6, 2):
        for _ in range(20):
            assert not practice.interfered.any()
            practice.execute(np.full(40, wish))
            assert (practice.last == wish).all()
    counts = practise(Transformer(), practice, 40, 0.0, np.random.default_rng(4)).counts
    assert counts[:, 0].all()


def test_what_the_network_or_a_shield_drove_is_not_learned_from(houses):
    practice = Practice(make_apartments(houses), 60, np.random.default_rng(3))
    expert = practise(Transformer(), practice, 60, 0.0, np.random.default_rng(4))
    left_alone = ~(practice.held | practice.steered)
    assert 10 < left_alone.sum() < 50
    assert expert.counts[left_alone, 0].all()
    for i in np.nonzero(left_alone)[0]:
        assert expert.counts[i, : expert.length[i]].all()
    assert not expert.counts[~left_alone].all(axis=1).any()
    mixed = practise(Transformer(), practice, 60, 1.0, np.random.default_rng(4))
    learned, at_once = mixed.counts.sum(axis=1), ~mixed.counts[:, 0]
    assert (learned <= 60 - ALONE[0])[at_once].all()
    assert 15 < at_once.sum() < 60


def test_a_training_learns_and_its_seed_decides_it(houses):
    settings, losses = Settings(houses=1, rounds=6, robots=16, steps=24, recent=2), []
    first = export(train(settings, 0, houses, lambda report: losses.append(report.loss)))
    assert losses[-1] < 0.8 * losses[0]
    again = export(train(settings, 0, houses, lambda report: None))
    assert all(np.array_equal(first[name], again[name]) for name in first)
    restored = export(restore(first))
    assert all(np.array_equal(first[name], restored[name]) for name in first)
