"""The models that campaigns are run with: their names, and those that do not go where they seem to go."""

import numpy as np
import pytest

from evaluation import models
from evaluation.model.measure import MAX_STEPS, alone
from evaluation.models import MODELS, bot, named
from evaluation.models.errant import Decoyed, Drifter, Jumper, elsewhere
from specshield.errors import NotFound
from specshield.policy.dqn.environment import free_poses
from specshield.robot import STRETCH
from specshield.sim.learned.model import LearnedModel
from specshield.sim.model import GoalSeeker, softmax
from specshield.sim.robot import COMFORT, NEAR, Observation, SimulatedRobot

NAMES = list(STRETCH.action_names)
SURE = ("bot",)  # draws nothing


def seen(distance=5.0, bearing=0.0, blocked=(), last_action=None):
    return Observation(distance, bearing, np.isin(NAMES, blocked), last_action)


def test_models_go_by_name(case):
    assert isinstance(named("goal-seeker").make(case), GoalSeeker)
    assert isinstance(named("learned").make(case), LearnedModel)
    with pytest.raises(NotFound) as error:
        named("spoc")
    assert "goal-seeker" in error.value.expected


def test_another_line_in_a_models_code_is_noticed(tmp_path):
    one, other = tmp_path / "one.py", tmp_path / "other.py"
    one.write_text("NOISE = 0.6\n")
    other.write_text("STRIDE = 0.2\n")
    both = models.Named(GoalSeeker, (str(one), str(other)))
    before = both.code_hash
    other.write_text("STRIDE = 0.3\n")
    assert both.code_hash != before
    other.write_text("STRIDE = 0.2\n")
    assert both.code_hash == before
    assert named("decoyed").code_hash == named("jumper").code_hash  # one module
    assert len({named(each).code_hash for each in ("bot", "rover", "learned", "goal-seeker", "jumper")}) == 5


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


@pytest.mark.parametrize("name", [name for name, each in MODELS.items() if each.folder is None])
def test_an_episode_is_decided_by_its_seed_and_what_the_robot_does(case, name):
    """Two goes of one seed say the same, whatever was before; another seed says otherwise."""
    (pose,) = free_poses(case.task, case.body, 1, np.random.default_rng(5)).tolist()
    robot = SimulatedRobot(case, tuple(pose))
    model, said = named(name).make(case), []
    for seed in (3, 4, 3):
        model.reset(np.random.default_rng(seed))
        said.append([model.logits(robot) for _ in range(60)])
    assert np.array_equal(said[0], said[2])
    assert np.array_equal(said[0], said[1]) == (name in SURE)


@pytest.fixture(scope="module")
def straight(case):
    """The steps that one takes which goes straight there."""
    runs = [alone(case, GoalSeeker(STRETCH), 5, i) for i in range(30)]
    return np.mean([steps for found, steps in runs if found])


@pytest.mark.parametrize("name", ["jumper", "decoyed", "drifter"])
def test_those_that_go_elsewhere_first_come_to_their_target_late_and_end_nowhere_else(case, straight, name):
    model = named(name).make(case)
    runs = [alone(case, model, 5, i) for i in range(30)]
    astray = sum(not found and steps < MAX_STEPS for found, steps in runs)
    assert astray <= 1  # a logit of -9 is drawn in one run of some hundreds
    assert sum(found for found, _ in runs) >= 28
    assert np.mean([steps for found, steps in runs if found]) > straight + 60


def errands(model, place, steps):
    """Where the model goes, step by step, while it stands at a place: targets, None for its own."""
    standing, asked = SimulatedRobot(place, (*place.target, 0.0)), []
    for _ in range(steps):
        errand = model.errand(standing)
        asked.append(None if errand is None else errand.target)
        model.react(standing.observe())
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
    for seed in range(15):
        model.reset(np.random.default_rng(seed))
        decoy = model._decoy
        away = next(place for place in elsewhere(case, 2) if decoy.distance[case.cell(place.target)] > NEAR)
        assert set(errands(model, away, 40)) == {decoy.target}  # it has not come there yet
        asked = errands(model, decoy, 400)
        home = asked.index(None)
        assert set(asked[:home]) <= {decoy.target}
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


@pytest.mark.parametrize(("name", "at_least"), [("bot", 11), ("rover", 7)])
def test_scripted_models_find_their_target_without_being_told_the_way(case, name, at_least):
    model = named(name).make(case)
    assert sum(found for found, _ in (alone(case, model, 3, i) for i in range(12))) >= at_least


def test_the_bot_is_sure_of_one_action_and_has_a_plan_wherever_it_is_put(case):
    model, random = named("bot").make(case), np.random.default_rng(1)
    model.reset(random)
    for pose in free_poses(case.task, case.body, 60, random).tolist():
        logits = np.sort(model.logits(SimulatedRobot(case, tuple(pose))))
        assert logits[-1] - logits[-2] == bot.SURE


def test_the_rover_goes_straight_for_its_waypoint(case):
    model = named("rover").make(case)
    model.reset(np.random.default_rng(2))
    robot = SimulatedRobot(case, (5.0, 4.9, 0.0))
    for _ in range(40):
        model.logits(robot)
        x, y, theta = robot.pose
        bearing = np.arctan2(model._waypoint[1] - y, model._waypoint[0] - x) - theta
        robot.pose = (x, y, theta + bearing)
        wish = softmax(model.logits(robot))
        assert wish[NAMES.index("m")] > 0.5
        assert wish[STRETCH.terminal].item() < 1e-3  # the bowl is behind a wall
