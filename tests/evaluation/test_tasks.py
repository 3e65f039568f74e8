"""Harder main tasks: what a case's name says of them, and when they count as done."""

import numpy as np
import pytest

from evaluation.experiment import Experiment
from evaluation.houses import load_house_case
from evaluation.models.order import END, SUB_DONE, InOrder
from evaluation.runs import run
from evaluation.tasks import MAX_STEPS, MainTask, is_done, main_task
from specshield.errors import InputError
from specshield.sim.robot import SimulatedRobot


class Ender:
    """Wants to end, whatever it sees; a temperature decides how much."""

    def __init__(self, case, sure=9.0):
        self.case, self.sure = case, sure

    def reset(self, random):
        pass

    def logits(self, robot):
        logits = np.zeros(20)
        logits[END] = self.sure
        return logits


def test_a_name_says_the_task():
    assert main_task("case1") == MainTask("case1", False, MAX_STEPS)
    assert main_task("case2-two") == MainTask("case2", True, MAX_STEPS)
    assert main_task("case1-two-300") == MainTask("case1", True, 300)
    assert main_task("house-200") == MainTask("house", False, 200)
    for wrong in ("house-two", "case1-0", "case1-9000"):
        with pytest.raises(InputError):
            main_task(wrong)
    with pytest.raises(InputError):  # where the world is another, so is where things are seen
        Experiment("case1-two", noise="obstacle")


def test_a_suffix_changes_neither_rule_nor_map():
    plain, two = Experiment("case1").setting, Experiment("case1-two", model="goal-seeker").setting
    assert (two.case.name, two.case.instruction) == ("case1-two", "find a bowl, then a pillow")
    assert two.task.content_hash == plain.task.content_hash
    assert two.learned is not None
    assert Experiment("case1-200").setting.case.name == "case1-200"


def test_sub_done_passes_on_to_the_next_thing_where_it_was_meant():
    setting = Experiment("case1-two", model="goal-seeker").setting
    first, second = setting.plain, setting.case
    stages = [first, second]
    model, robot = InOrder(Ender, stages), SimulatedRobot(second, (*first.target, 0.0))
    logits = model.logits(robot)
    assert (int(np.argmax(logits)), logits[END]) == (SUB_DONE, 0.0)
    robot.execute(2)
    model.logits(robot)
    assert model.found == []  # it was not executed
    robot.execute(SUB_DONE)
    assert int(np.argmax(model.logits(robot))) == END
    assert model.found == [True]
    assert not is_done(model, robot)
    robot.pose = (*second.target, 0.0)
    assert is_done(model, robot)
    model.reset(np.random.default_rng(0))
    model.logits(robot)  # beside the second thing, it takes it for the first
    robot.execute(SUB_DONE)
    model.logits(robot)
    assert model.found == [False]
    assert not is_done(model, robot)
    waits = InOrder(lambda case: Ender(case, sure=-5.0), stages)
    waits.logits(robot)
    robot.execute(SUB_DONE)  # a shield's way of waiting
    waits.logits(robot)
    assert waits.found == []


def test_a_run_ends_at_its_limit_and_two_things_take_longer_than_one():
    (short,) = run(Experiment("case1-20", model="goal-seeker"), 0, ["unmodified"])
    assert (short.steps, short.main_done) == (20, False)
    one, two = (
        [run(Experiment(case, model="goal-seeker", seed=2), i, ["unmodified"])[0] for i in range(6)]
        for case in ("case2", "case2-two")
    )
    assert sum(record.main_done for record in two) >= 5
    assert np.mean([record.steps for record in two]) > 1.5 * np.mean([record.steps for record in one])


def test_a_large_house_is_large():
    case = load_house_case("large_0")
    grid = case.task.grid
    assert (grid.width * grid.resolution, grid.height * grid.resolution) == pytest.approx((15.0, 12.0))
    assert np.isfinite(case.distance[case.cell(case.target)])
