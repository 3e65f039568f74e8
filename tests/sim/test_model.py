import math

import numpy as np
import pytest

from specshield.policy.dqn.environment import free_poses
from specshield.robot import STRETCH
from specshield.sim.model import GoalSeeker, softmax
from specshield.sim.robot import Observation, SimulatedRobot
from tests.oracles.judge import margin

NAMES = list(STRETCH.action_names)


def seen(distance=5.0, bearing=0.0, blocked=(), last_action=None):
    return Observation(distance, bearing, np.isin(NAMES, blocked), last_action)


def mean_probabilities(observation, n=400):
    """By name, over the model's noise."""
    model = GoalSeeker(STRETCH)
    model.reset(np.random.default_rng(0))
    return dict(
        zip(NAMES, np.mean([softmax(model.react(observation)) for _ in range(n)], axis=0), strict=True)
    )


@pytest.mark.parametrize(
    ("observation", "wanted"),
    [
        (seen(bearing=0.0), "m"),
        (seen(bearing=math.pi / 2), "l"),
        (seen(bearing=-math.pi / 2), "r"),
        (seen(bearing=math.pi), "b"),
        (seen(bearing=0.0, blocked=["m", "ls", "l"]), "rs"),
        (seen(distance=0.3, bearing=2.0), "end"),
    ],
    ids=["ahead", "left", "right", "behind", "blocked", "there"],
)
def test_it_prefers_what_brings_it_nearer(observation, wanted):
    chances = mean_probabilities(observation)
    if wanted == "b":  # a turn either way is as good
        assert chances["b"] > chances["m"]
        assert chances["l"] + chances["r"] + chances["b"] > 0.8
    else:
        assert max(chances, key=chances.get) == wanted


def test_every_logit_is_finite_and_the_distribution_spread():
    model = GoalSeeker(STRETCH)
    model.reset(np.random.default_rng(0))
    random = np.random.default_rng(1)
    entropies = []
    for _ in range(500):
        logits = model.react(seen(random.uniform(0, 10), random.uniform(-math.pi, math.pi)))
        assert logits.shape == (20,)
        assert np.all(np.isfinite(logits))
        p = softmax(logits)
        entropies.append(-np.sum(p * np.log(p)))
    assert 0.5 < np.mean(entropies) < 2.0
    assert np.mean(np.array(entropies) < 0.1) < 0.02


def test_it_ends_near_the_target_alone():
    assert mean_probabilities(seen(distance=0.5))["end"] > 0.25
    assert mean_probabilities(seen(distance=1.2))["end"] < 1e-4


def test_it_repeats_itself_and_remembers_within_an_episode_but_not_beyond():
    again = mean_probabilities(seen(bearing=0.3, last_action=NAMES.index("m")))
    assert again["m"] > mean_probabilities(seen(bearing=0.3))["m"]
    model, first = GoalSeeker(STRETCH), []
    for seed in (0, 0, 1):
        model.reset(np.random.default_rng(seed))
        first.append([model.react(seen()) for _ in range(3)])
    assert np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], first[2])
    noise = np.array([model.react(seen())[0] for _ in range(2000)])
    assert np.corrcoef(noise[:-1], noise[1:])[0, 1] == pytest.approx(GoalSeeker.DRIFT, abs=0.08)


def alone(case, model, runs):
    """Of each run: its poses, whether the model ended, and whether at its target."""
    for i, start in enumerate(free_poses(case.task, case.body, runs, np.random.default_rng(5)).tolist()):
        robot, random = SimulatedRobot(case, tuple(start)), np.random.default_rng([i, 1])
        model.reset(np.random.default_rng([i, 0]))
        poses, ended = [robot.pose], False
        while not ended and len(poses) <= 600:
            logits = model.logits(robot)
            assert np.all(np.isfinite(logits))
            action = int(random.choice(20, p=softmax(logits)))
            ended = bool(STRETCH.terminal[action])
            if not ended:
                robot.execute(action)
                poses.append(robot.pose)
        yield poses, ended, ended and robot.at_target


def test_alone_it_finds_its_target_from_everywhere_and_breaks_the_rule(case):
    runs, found, kept = 60, 0, 0
    for poses, _, done in alone(case, GoalSeeker(STRETCH), runs):
        found += done
        poses += poses[-1:] * (case.task.horizon + 1 - len(poses))
        kept += margin(case.spec, poses) > 0
    assert found >= 0.95 * runs
    assert kept <= 0.1 * runs
