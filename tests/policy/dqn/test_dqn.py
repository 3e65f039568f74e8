"""Training: it learns, it can be repeated, stopped and resumed."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest

from specshield.errors import FragmentError
from specshield.policy.dqn import train as training
from specshield.policy.dqn.method import Settings
from specshield.policy.dqn.network import NAMES
from specshield.policy.dqn.train import Replay, Training, measure, train, weights_of
from specshield.policy.methods import Run, load_policy
from specshield.policy.options import read_options
from tests.policy.rooms import flat

TASK = flat("F[0,30] West and G[0,30] not Hole")
SMALL = Settings(
    units=32, updates=1200, robots=128, batch=256, learning_rate=2e-3, discount=0.95, polyak=0.02,
    replay=80_000, evaluate_every=300, evaluation_starts=200,
)  # fmt: skip
TINY = replace(SMALL, updates=40, robots=16, batch=32, replay=2000, evaluate_every=20, evaluation_starts=20)


def same(a, b):
    return all((a[name] == b[name]).all() for name in NAMES)


def test_a_short_training_beats_chance_clearly():
    reports: list[tuple[float, float, str]] = []
    policy = train(TASK, SMALL, Run(on_progress=lambda *report: reports.append(report)))
    untrained = measure(TASK, weights_of(Training(TASK, SMALL, 0).q_network), 200, 0)
    metrics = policy.card["metrics"]
    assert metrics["satisfied"] > 0.4 + untrained["satisfied"]
    assert metrics["feasible_start"] >= metrics["satisfied"]
    low, high = metrics["satisfied_interval"]
    assert low < metrics["satisfied"] < high
    assert metrics["wall_time_s"] > 0
    assert [done for done, _, _ in reports] == [update / 1200 for update in range(100, 1201, 100)]
    assert reports[-1][1] == 0.0
    assert reports[1][2] == "update 200 of 1200, not measured yet"
    assert re.fullmatch(r"update 300 of 1200, satisfied [0-9]{1,3}\.[0-9]%", reports[2][2])
    again = load_policy(policy.weights(), policy.card, TASK)
    assert same(again.network._asdict(), policy.network._asdict())
    assert read_options(Settings, policy.card["options"]) == SMALL


@pytest.mark.parametrize("reward", ["progress", "paper"])
def test_one_seed_one_policy(reward):
    settings = replace(TINY, reward=reward)
    first, second, other = (train(TASK, settings, Run(seed)).network._asdict() for seed in (1, 1, 2))
    assert same(first, second)
    assert not same(first, other)


def test_a_stopped_training_resumes_where_its_checkpoint_was(tmp_path, monkeypatch):
    def stop(done: float, *_: object) -> None:
        if done * TINY.updates == 30:
            raise InterruptedError

    monkeypatch.setattr(training, "REPORT_EVERY", 10)
    with pytest.raises(InterruptedError):
        train(TASK, TINY, Run(3, checkpoints=tmp_path, on_progress=stop))
    monkeypatch.undo()
    resumed = Training(TASK, TINY, 3)
    resumed.resume(tmp_path)
    assert (resumed.update, resumed.best_rate) == (20, resumed.latest)
    assert not same(weights_of(resumed.q_network), weights_of(Training(TASK, TINY, 3).q_network))
    resumed.save(tmp_path)
    again = Training(TASK, TINY, 3)
    again.resume(tmp_path)
    for name in ("q_network", "target_network", "best"):
        assert same(weights_of(getattr(again, name)), weights_of(getattr(resumed, name)))
    assert not same(weights_of(again.q_network), weights_of(again.target_network))
    for one, two in zip(again.q_network.parameters(), resumed.q_network.parameters(), strict=True):
        moments, expected = again.optimizer.state[one], resumed.optimizer.state[two]
        assert all((moments[name] == expected[name]).all() for name in ("step", "exp_avg", "exp_avg_sq"))
    told = []
    policy = train(TASK, TINY, Run(3, checkpoints=tmp_path, on_progress=lambda done, *_: told.append(done)))
    assert told == [1.0]
    assert policy.card["metrics"]["wall_time_s"] >= 0


def test_another_trainings_checkpoint_is_ignored_and_a_damaged_one(tmp_path):
    train(TASK, TINY, Run(checkpoints=tmp_path))
    for task, settings, seed in (
        (flat("F[0,31] West"), TINY, 0),
        (TASK, replace(TINY, discount=0.9), 0),
        (TASK, TINY, 1),
    ):
        other = Training(task, settings, seed)
        other.resume(tmp_path)
        assert other.update == 0
    kept = tmp_path / "state.safetensors"
    for damaged in (b"", bytes(500), kept.read_bytes()[:-1]):
        kept.write_bytes(damaged)
        again = Training(TASK, TINY, 0)
        again.resume(tmp_path)
        assert again.update == 0


def test_robots_that_never_explore_can_learn():
    assert Training(TASK, replace(TINY, exploration=(0.0, 0.0)), 0).epsilon.max() < 1e-5


def test_nothing_is_trained_outside_the_fragment():
    with pytest.raises(FragmentError):
        train(flat("West U[0,9] East"), TINY, Run())


def test_the_replay_returns_n_steps_by_hand():
    """Two robots, one with rewards 0, 1, 2, ... and one with tens of them; nine steps in a ring of six."""
    replay = Replay(6, 2, 1)
    for step in range(9):
        reward, ended = np.float32([step, 10 * step]), np.array([step == 5, False])
        replay.add(np.float32([[step], [100 + step]]), np.array([step, -step]), reward, ended)
    batch = replay.sample(np.random.default_rng(0), 500, 2, 0.5)
    for seen, motion, returns, factor, then in zip(*batch, strict=True):
        second, step = divmod(int(seen[0]), 100)
        assert 3 <= step <= 6  # the first three are gone, the last two have no state two steps on
        assert then[0] == seen[0] + 2
        assert motion == (-step if second else step)
        if second:
            assert (returns, factor) == (10 * step + 0.5 * 10 * (step + 1), 0.25)
        elif step == 5:
            assert (returns, factor) == (5, 0)  # nothing after an end counts
        else:
            assert (returns, factor) == (step + 0.5 * (step + 1), 0 if step == 4 else 0.25)


def test_measured_rates_have_exact_intervals():
    """Clopper and Pearson, 1934: of 20, none gives [0, 0.1684] and all [0.8316, 1]."""
    for formula, rate, interval in (
        ("F[0,1] West and F[0,1] East", 0.0, [0.0, 0.1684]),
        ("F[0,1] x > -99", 1.0, [0.8316, 1.0]),
    ):
        task = flat(formula)
        measured = measure(task, weights_of(Training(task, TINY, 0).q_network), 20, 0)
        for name in ("satisfied", "feasible_start"):
            assert (measured[name], measured[f"{name}_interval"]) == (rate, interval)


def test_a_measured_rate_between_has_the_interval_that_scipy_has():
    task = flat("F[0,1] x > 1")
    measured = measure(task, weights_of(Training(task, TINY, 0).q_network), 20, 0)
    assert 0.0 < measured["satisfied"] < 1.0
    expected = binomtest(round(20 * measured["satisfied"]), 20).proportion_ci(0.95)
    assert measured["satisfied_interval"] == pytest.approx([expected.low, expected.high], abs=5e-5)
