"""What `make results` runs."""

import json
from dataclasses import replace
from pathlib import Path

from evaluation import campaigns, plan
from evaluation.experiment import Experiment, split
from evaluation.houses import houses_in, load_house_case
from tests.houses import HOUSES, needs_houses


def test_every_method_of_the_plan_is_one_and_no_experiment_is_run_twice():
    found = list(plan.plan(["somewhere/house_0.json"]))
    for each in found:
        for method in each.methods:
            split(method.replace("@conformal", "@0"))
    assert len({each.experiment for each in found}) == len(found)
    noisy = next(each for each in found if each.experiment.noise == "gaussian")
    assert {"paper@conformal/8", "ours@conformal/8", "paper@default", "ours@default"} <= set(noisy.methods)
    assert found[0].kind == "cases"


def test_a_campaign_that_fails_is_told_and_the_others_are_run(tmp_path, monkeypatch, capsys):
    """And what was run is not run again."""
    there = plan.Campaign("cases", Experiment("case1"), 40, ("unmodified",))
    gone = replace(there, experiment=Experiment("house", "house_99"))
    monkeypatch.setattr(plan, "plan", lambda houses: [gone, there])
    page = tmp_path / "docs" / "results.md"
    assert plan.carry_out(tmp_path / "out", page, [], [], 0.001, 1) == 1
    said = capsys.readouterr()
    assert "house_99" in said.err
    assert "[2 of 2 campaigns" in said.out
    kept = tmp_path / "out" / "learned" / "case1" / "none"
    assert json.loads((kept / "results.json").read_text())["runs"] == plan.LEAST
    assert "| method | rule, learned |" in page.read_text()
    assert "| unmodified |" in page.read_text()
    monkeypatch.setattr(campaigns.evaluation, "run", None)
    assert plan.carry_out(tmp_path / "out", page, [], ["cases"], 0.001, 1) == 1


@needs_houses
def test_every_procthor_house_beside_the_project_is_a_case():
    found = houses_in(HOUSES)
    assert [Path(path).stem for path in found] == [f"house_{i}" for i in (0, 1, 10, 14, 2, 5)]
    for path in found:
        case = load_house_case(path)
        assert not case.task.grid.occupied[case.cell(case.target)]


def test_there_are_no_houses_where_there_is_no_folder(tmp_path):
    assert houses_in(tmp_path / "nowhere") == []
