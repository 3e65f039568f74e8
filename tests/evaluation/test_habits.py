"""What shields may break of a model: its habit near people, and its memory of its way."""

import numpy as np
import pytest

from evaluation.model.measure import alone
from evaluation.models import courteous, follower, named
from specshield.robot import STRETCH
from specshield.sim.model import softmax
from specshield.sim.robot import SimulatedRobot

AHEAD = STRETCH.action_names.index("m")


def driven(case, model, i, steps):
    """The poses of a run of the model alone."""
    robot, random = SimulatedRobot(case, (5.0, 4.7, 0.1 * i)), np.random.default_rng(i)
    model.reset(np.random.default_rng(i))
    poses = [robot.pose]
    for _ in range(steps):
        action = int(random.choice(20, p=softmax(model.logits(robot))))
        if STRETCH.terminal[action]:
            break
        robot.execute(action)
        poses.append(robot.pose)
    return poses


def test_alone_the_courteous_keeps_its_habit_and_the_follower_its_way(case):
    model, way = named("courteous").make(case), named("follower").make(case)
    near, hasty = np.sum([courteous.habit(case, driven(case, model, i, 150)) for i in range(6)], axis=0)
    assert near > 30
    assert hasty <= 0.05 * near
    for i in range(6):
        assert not follower.lost(case, driven(case, way, i, 300))
    assert sum(alone(case, way, 4, i)[0] for i in range(6)) == 6


def test_moving_on_near_people_is_hasty_and_elsewhere_it_is_not(case):
    there, away = courteous.people(case)[0], np.array([100.0, 100.0])
    for place, expected in ((there, (4, 2)), (away, (0, 0))):
        way = [(place[0] + dx, place[1], 0.0) for dx in (0.0, 0.2, 0.4, 0.4, 0.2, 0.0)]
        assert courteous.habit(case, way) == expected


@pytest.mark.parametrize(("detour", "lost"), [(follower.MEMORY, False), (follower.MEMORY + 1, True)])
def test_a_detour_longer_than_its_memory_loses_the_follower(case, detour, lost):
    start = (5.0, 4.7, 0.0)
    way = follower.route(case, start)
    on_it, off_it = (*way[40], 0.0), (way[40][0] + 50.0, 0.0, 0.0)
    poses = [start, *[off_it] * detour, (*way[30], 0.0), on_it]
    assert follower.lost(case, [list(pose) for pose in poses]) is lost
    assert np.hypot(*np.diff(way, axis=0).T).max() < 0.1
    assert np.hypot(*(way[-1] - case.target)) < 1e-9


def test_a_rivals_slack_follows_window_and_resistance():
    from evaluation.experiment import Experiment
    from evaluation.slacks import Adaptive, proportional
    from specshield.shield.decision import Config

    setting = Experiment("case2", model="goal-seeker").setting
    assert proportional(setting.task, Config(slack=50)).slack == 25  # its windows are 50 steps long
    method = setting.method("adaptive@0/20")
    assert isinstance(method, Adaptive)
    method.begin(0)
    calm = np.zeros(20)
    asked = []
    for logits in [calm] * 30:
        answer = method.act(np.array([[5.0, 4.7, 0.0]]), logits, 0.5)
        asked.append(method._shield.config.slack)
        assert answer.feasible_mass == pytest.approx(1.0)
    assert asked[0] == 10
    assert asked[-1] == 0
