import math

import numpy as np
import pytest

from specshield.errors import NotFound
from specshield.policy.dqn.environment import free_poses
from specshield.robot import STRETCH
from specshield.sim.model import MODELS, Decoyed, Drifter, GoalSeeker, Jumper, elsewhere, make_model, softmax
from specshield.sim.robot import COMFORT, NEAR, Observation, SimulatedRobot
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


def test_models_go_by_name(case):
    assert isinstance(make_model("goal-seeker", case), GoalSeeker)
    with pytest.raises(NotFound) as error:
        make_model("spoc", case)
    assert "goal-seeker" in error.value.expected


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


def test_other_places_are_reachable_roomy_and_far_apart(case):
    places = elsewhere(case, 8)
    assert [place.target for place in elsewhere(case, 3)] == [place.target for place in places[:3]]
    apart = []
    for i, place in enumerate(places):
        cell = case.cell(place.target)
        assert case.task.grid.clearance[cell] > COMFORT
        apart.append(min(before.distance[cell] for before in [case, *places[:i]]))
    assert sorted(apart, reverse=True) == pytest.approx(apart)  # the farthest first
    assert 2.0 < apart[-1] < np.inf


@pytest.mark.parametrize("name", [name for name in MODELS if name != "learned"])
def test_an_episode_is_decided_by_its_seed_and_what_the_robot_does(case, name):
    """Two goes of one seed say the same, whatever was before; another seed says otherwise."""
    robot = SimulatedRobot(case, next(alone(case, GoalSeeker(STRETCH), 1))[0][0])
    model, said = make_model(name, case), []
    for seed in (3, 4, 3):
        model.reset(np.random.default_rng(seed))
        said.append([model.logits(robot) for _ in range(60)])
    assert np.array_equal(said[0], said[2])
    assert not np.array_equal(said[0], said[1])


@pytest.mark.parametrize("name", ["jumper", "decoyed", "drifter"])
def test_those_that_go_elsewhere_first_come_to_their_target_late_and_end_nowhere_else(case, name):
    seeker = [len(poses) for poses, _, done in alone(case, GoalSeeker(STRETCH), 30) if done]
    runs = list(alone(case, make_model(name, case), 30))
    assert all(ended == done for _, ended, done in runs)
    assert sum(done for *_, done in runs) >= 28
    assert np.mean([len(poses) for poses, _, done in runs if done]) > np.mean(seeker) + 60


def errands(model, place, steps):
    """Where the model asks the way to while it stands at a place: targets, None for its own."""
    asked = []

    class Standing(SimulatedRobot):
        def observe(self, errand=None):
            asked.append(None if errand is None else errand.target)
            return super().observe(errand)

    standing = Standing(place, (*place.target, 0.0))
    for _ in range(steps):
        model.logits(standing)
    return asked


def test_where_the_jumper_goes_and_when_is_the_same_wherever_it_is(case):
    model, found = Jumper(case), []
    for place in elsewhere(case, 2):
        model.reset(np.random.default_rng(6))
        found.append(errands(model, place, 400))
    assert found[0] == found[1]
    changes = sum(one != other for one, other in zip(found[0], found[0][1:], strict=False))
    assert 2 <= changes <= 40
    home = found[0].index(None)
    assert found[0][home:] == [None] * (400 - home)


def test_the_decoyed_turns_to_its_target_once_it_has_been_about_its_decoy_for_long(case):
    model, stays = Decoyed(case), []
    for seed in range(40):
        model.reset(np.random.default_rng(seed))
        decoy = model._decoy
        away = next(place for place in elsewhere(case, 2) if decoy.distance[case.cell(place.target)] > NEAR)
        assert set(errands(model, away, 40)) == {decoy.target}  # it has not come there yet
        asked = errands(model, decoy, 400)
        home = asked.index(None)
        assert set(asked[:home]) == {decoy.target}
        assert set(asked[home:]) == {None}
        stays.append(len(asked[home:]))
    assert 0.6 * Decoyed.STAY < 401 - np.mean(stays) < 1.6 * Decoyed.STAY


def test_the_drifter_goes_nowhere_for_long_and_its_likings_last():
    model, lasts, forward = Drifter(STRETCH), [], NAMES.index("m")
    for seed in range(40):
        model.reset(np.random.default_rng(seed))
        lasts.append(model._left)
        one = np.array([model.react(seen(bearing=1.0, distance=0.1)) for _ in range(lasts[-1] + 1)])
        model.reset(np.random.default_rng(seed))
        other = np.array([model.react(seen(bearing=-2.0)) for _ in range(lasts[-1] + 1)])
        assert np.array_equal(one[:-1], other[:-1])  # whatever the way
        assert np.all(one[:-1, NAMES.index("end")] == Drifter.END_FAR)
        assert one[-1, forward] > other[-1, forward] + 1.0  # then towards the target
    assert 0.6 * Drifter.WHILE < np.mean(lasts) < 1.6 * Drifter.WHILE

    model.reset(np.random.default_rng(0))
    model._left = 8000
    said = np.array([model.react(seen()) for _ in range(8000)])[:, forward]
    assert abs(said.mean()) < 1.0
    assert said.std() == pytest.approx(Drifter.LIKING, rel=0.2)
    for lag in (1, 20):
        assert np.corrcoef(said[:-lag], said[lag:])[0, 1] == pytest.approx(Drifter.LASTING**lag, abs=0.1)


def test_the_drifter_sees_what_is_blocked():
    model, said = Drifter(STRETCH), []
    for blocked in ((), ("m", "ls")):
        model.reset(np.random.default_rng(0))
        said.append(model.react(seen(blocked=blocked)))
    assert dict(zip(NAMES, said[1] - said[0], strict=True)) == pytest.approx(
        dict.fromkeys(NAMES, 0.0) | {"m": Drifter.BLOCKED, "ls": Drifter.BLOCKED}
    )
