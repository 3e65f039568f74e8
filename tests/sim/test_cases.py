import json

import numpy as np
import pytest

from evaluation.shipped import shipped
from specshield import errors
from specshield.shipped import MAPS
from specshield.sim.cases import case_name, load_case
from specshield.stl import parse


def test_a_case_is_what_its_files_say(case):
    beside = json.loads((MAPS / f"{case.name}.regions.json").read_text())
    assert case.task.formula == parse(beside["formula"])
    assert case.target in [tuple(point) for point in beside["targets"].values()]
    assert case.task.robot.name == "stretch"
    assert case.distance[case.cell(case.target)] == 0.0
    row, column = case.cell((case.target[0] - 0.5, case.target[1]))
    assert case.distance[row, column] == pytest.approx(0.5, abs=0.051)
    assert np.all(np.isinf(case.distance) == case.task.grid.occupied)


@pytest.mark.parametrize("method", ["reachability", "dqn"])
def test_the_policies_shipped_for_a_case_are_for_its_task_and_open_95_percent_of_the_starts(case, method):
    card = shipped(case, method).card
    assert card["method"] == method
    assert card["task_hash"] == case.task.content_hash
    assert card["map_id"] == case.task.grid.content_hash
    assert card["spec"] == case.spec
    assert card["metrics"]["feasible_start"] >= 0.95


def test_a_case_may_be_called_by_its_number():
    assert load_case("1").name == "case1"
    assert case_name("2") == "case2"


def test_an_unknown_case_is_told_with_those_there_are():
    with pytest.raises(errors.NotFound) as caught:
        load_case("case9")
    assert caught.value.expected == "one of case1, case2, case2b"
