"""The page and its figures, from records made by hand."""

import json

import pytest

pytest.importorskip("matplotlib")

from evaluation import figures, writeup
from evaluation.experiment import METHODS, Experiment
from evaluation.models import MODELS
from evaluation.runs import Record
from specshield.errors import NotFound
from specshield.sim.cases import load_case


def record(run, method, **fields):
    usual = {
        "run": run, "method": method, "seed": run, "start": (2.0, 2.0, 0.0), "refused": 0, "satisfied": True,
        "rho": 0.1, "main_done": True, "ended_at": 10, "broken": [], "steps": 10, "modes": {"shaped": 10},
        "reasons": {}, "kl": 2.0, "asked": 10, "residual": 0.0, "mass": [1.0, None, 0.5],
        "decision_ms": [1.0, 2.0, 3.0], "certified": [], "poses": [[2.0, 2.0, 0.0]],
    }  # fmt: skip
    return Record(**(usual | fields))


def test_methods_of_other_runs_are_compared_over_those_in_common(tmp_path):
    plain = [record(i, "unmodified", main_done=i != 1, ended_at=3) for i in range(6)]
    fewer = [record(i, "ours", ended_at=8) for i in (1, 0)]
    others = [record(i, "simplex", ended_at=5 + i, main_done=i != 5) for i in range(4, 8)]
    folder = tmp_path / "case1" / "none"
    folder.mkdir(parents=True)
    (folder / "experiment.json").write_text(json.dumps(Experiment("case1").to_json()))
    lines = [json.dumps(each.to_json()) + "\n" for each in plain + fewer + others]
    (folder / "runs.jsonl").write_text("".join(lines))
    writeup.write_up(tmp_path, tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text()
    assert "- ours: main task -50.0 points below unmodified.\n" in page
    assert "main task +50.0 points below unmodified over the 2 runs that both have.\n" in page
    assert "unmodified does its task in 5 of 6 runs." in page
    found = {one["method"]: one for one in json.loads((folder / "results.json").read_text())["methods"]}
    assert (found["ours"]["extra_steps"]["both"], found["ours"]["extra_steps"]["mean"]) == (1, 5.0)
    assert (found["simplex"]["extra_steps"]["both"], found["simplex"]["extra_steps"]["mean"]) == (1, 6.0)
    for runs, method in ((6, "unmodified"), (2, "ours"), (4, "simplex")):
        assert f"--runs {runs} --seed 0 --model learned --noise none --methods {method} --out" in page


def test_several_models_share_a_page(tmp_path):
    folder = tmp_path / "results-two"
    for model in ("jumper", "drifter"):
        kept = folder / model / "case1" / "none"
        kept.mkdir(parents=True)
        (kept / "experiment.json").write_text(json.dumps(Experiment("case1", model=model).to_json()))
        lines = [json.dumps(record(0, name).to_json()) + "\n" for name in ("ours", "lookahead")]
        (kept / "runs.jsonl").write_text("".join(lines))
    writeup.write_up(folder, tmp_path / "two.md")
    page = (tmp_path / "two.md").read_text()
    for model in ("jumper", "drifter"):
        assert page.count(f"## case1, {model}: method by method\n") == 1
        assert f"| case1, {model} | lookahead |" in page
        assert f"![ways of case1, {model}](two/{model}/case1/ways.png)" in page
        assert (tmp_path / "two" / model / "case1" / "ways.png").is_file()
        assert f"--model {model} --noise none --methods ours,lookahead --out out/results-two/{model}" in page
    assert "specshield report out/results-two --out docs/two.md\n" in page


def test_a_folder_without_results_is_said_to_be(tmp_path):
    kept = tmp_path / "results" / "case1" / "none"
    kept.mkdir(parents=True)
    (kept / "experiment.json").write_text(json.dumps(Experiment("case1").to_json()))
    (kept / "runs.jsonl").write_text(json.dumps(record(0, "ours").to_json()) + "\n")
    begun = tmp_path / "begun" / "case1" / "none"  # no run of it is finished
    begun.mkdir(parents=True)
    (begun / "experiment.json").write_text(json.dumps(Experiment("case1").to_json()))
    for part in (kept, kept.parent, tmp_path / "begun"):
        with pytest.raises(NotFound, match="no results"):
            writeup.write_up(part, tmp_path / "page.md")


def test_every_model_is_described():
    assert set(writeup.MODELS) == set(MODELS)


@pytest.mark.parametrize("make", [figures._robustness, figures._mass])
def test_every_method_has_a_curve_of_its_own(make):
    names = ["unmodified", *(f"ours@0.0{i}" for i in range(10))]
    figure = make(load_case("case1"), {name: [record(0, name)] for name in names})
    curves = [line for line in figure.axes[0].lines if line.get_label() in names]
    assert [curve.get_label() for curve in curves] == names
    assert len({(curve.get_color(), curve.get_linestyle()) for curve in curves}) == len(names)
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == names


def test_every_method_is_described():
    assert set(writeup.METHODS) == set(METHODS)


def test_a_method_is_told_beside_ours_with_few_pairs_too():
    cost = {"pairs": 2, "mine": 5.0, "other": 4.0, "difference": 1.0, "difference_low": -1.0,
            "difference_high": 3.0, "share": 1.25, "low": None, "high": None}  # fmt: skip
    test = {"pairs": 4, "only": 1, "only_other": 0, "p": 1.0}
    none = {"pairs": 0, "mine": None, "share": None}
    found = {"satisfied": test, "main_done": test, "kl": cost, "extra_steps": none}
    assert list(writeup._beside_ours({"lookahead": found, "hcd": found})) == [
        "- lookahead, beside ours: KL a run 5.0 and 4.0 in 2 pairs, difference +1.0 (-1.0 to +3.0), ratio "
        "1.25 (not bounded), mean extra steps in no pair of runs; McNemar: rule p = 1, main task p = 1."
    ]
