"""The page and its figures, from records made by hand."""

import json
import math

import pytest

pytest.importorskip("matplotlib")

from evaluation import figures, results, writeup
from evaluation.experiment import METHODS, Experiment
from evaluation.models import MODELS
from evaluation.pages import words
from evaluation.pages.houses import overlaps
from evaluation.pages.tables import beside_ours
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
    page = (tmp_path / "page" / "cases.md").read_text()
    assert "there is a cost (harder tasks)" in page  # no link to a page that is not there
    assert "- ours: main task -50.0 points below unmodified.\n" in page
    assert "main task +50.0 points below unmodified over the 2 runs that both have.\n" in page
    assert "unmodified does its task in 5 of 6 runs." in page
    assert "0 more starts were drawn and refused, because `ours`, or the network alone where" in page
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
    page = (tmp_path / "two" / "models.md").read_text()
    for model in ("jumper", "drifter"):
        assert page.count(f"## case1, {model}\n") == 1
        assert f"| case1, {model} | lookahead |" in page
        assert f"--model {model} --noise none --methods ours,lookahead --out out/results-two/{model}" in page
    assert "[Other models](two/models.md)" in (tmp_path / "two.md").read_text()


def test_what_the_summary_says_is_in_the_records(tmp_path):
    """Two tiny campaigns: rule-first is quicker than ours; with noise, paper keeps the rule more often."""
    for noise, lost in (("none", 0), ("gaussian", 3)):
        kept = tmp_path / "out" / "learned" / "case1" / noise
        kept.mkdir(parents=True)
        (kept / "experiment.json").write_text(json.dumps(Experiment("case1", noise=noise).to_json()))
        records = [
            record(i, method, ended_at=end + i, kl=kl, satisfied=method != "ours" or i >= lost)
            for method, end, kl in (
                ("unmodified", 5, 0.0),
                ("ours", 30, 4.0),
                ("rule-first", 20, 9.0),
                ("paper", 30, 4.0),
            )
            for i in range(8)
        ]
        lines = [json.dumps(each.to_json()) + "\n" for each in records]
        (kept / "runs.jsonl").write_text("".join(lines))
    writeup.write_up(tmp_path / "out", tmp_path / "results.md")
    page = (tmp_path / "results.md").read_text()
    assert "| method | rule, learned | task, learned | KL, learned | extra steps, learned |" in page
    assert "| rule-first | 8 (63–100 %) | 8 (63–100 %) | 9 (9–9) | +15 (+15 to +15) |" in page
    assert "| unmodified | 8 (63–100 %) | 8 (63–100 %) | 0 | 0 |" in page
    assert "**rule-first**: extra steps (case1, learned)." in page
    assert "| gaussian noise, rule kept | ours | paper | rule-first | ours@default | paper@default |" in page
    kept = "5 of 8 (24.5 to 91.5 %) | 8 of 8 (63.1 to 100.0 %) | 8 of 8 (63.1 to 100.0 %)"
    assert f"| case1, learned | {kept} | not run | not run |" in page
    assert "loses the rule in 3 of 8 runs." in page
    assert (tmp_path / "results" / "learned" / "case1" / "ways.png").is_file()
    assert "](results/cases.md)" in page
    assert "](results/noise.md)" in page
    assert (
        "rule 3 runs it alone, 0 the other alone, of 8, p = 0.25"
        in (tmp_path / "results" / "noise.md").read_text()
    )
    cases = (tmp_path / "results" / "cases.md").read_text()
    assert "- **rule-first**, beside ours (case1, learned): extra steps -10.0 (-10.0 to -10.0), n 8." in cases
    assert "| case1, learned | unmodified | 0 % | 93.5 % | 8 of 8" in cases
    assert "KL a run 9.0 and 4.0, difference +5.0 (+5.0 to +5.0), n 8, ratio 2.25 (2.25 to 2.25)" in cases
    assert "](learned/case1/ways.png)" in cases


def test_the_summary_says_of_how_many_runs_it_is_and_nothing_of_runs_that_were_not_made(tmp_path):
    """Its words once told the figures of one campaign, whatever it was written from."""
    asked = [Experiment("case1", seed=5), Experiment("case1-200", seed=5)]
    for each in asked:
        kept = tmp_path / "out" / each.case / each.noise
        kept.mkdir(parents=True)
        (kept / "experiment.json").write_text(json.dumps(each.to_json()))
        records = [
            record(i, method, main_done=i != 1 or method != "ours")
            for method in ("unmodified", "ours", "lookahead")
            for i in range(3)
        ]
        (kept / "runs.jsonl").write_text("".join(json.dumps(one.to_json()) + "\n" for one in records))
        writeup.write_up(tmp_path / "out", tmp_path / "mine.md")
        page = (tmp_path / "mine.md").read_text()
        assert "run by run (seed 5)" in page
        assert "each row has 3 runs of each model" in page
        assert "loses the rule in" not in page
        assert ("With 200" in page) == (each.case == "case1-200")
    assert "in 3 of 3 (29.2 to 100.0 %), under `ours` in 2 of 3 (9.4 to 99.2 %)" in page
    assert "over the runs of one case and model, " in page
    assert "[harder tasks](mine/tasks.md)" in page
    assert "the pairs share starts" not in page
    cases = (tmp_path / "mine" / "cases.md").read_text()
    assert "80 of 80" not in cases
    assert "A line is the median of the runs, and the band around it the middle 80 %." in cases


def test_bodies_are_measured_by_the_distance_of_the_footprint(tmp_path):
    """Forbidden's left edge is at x0; the footprint's centre is 0.109 m behind an origin that faces it."""
    case = load_case("2b")
    (x0, y0), (_, y1) = (case.spec["regions"]["Forbidden"][corner] for corner in ("min", "max"))
    far = [x0 - 2.0, (y0 + y1) / 2, 0.0]
    near = [x0 - 0.01, (y0 + y1) / 2, 0.0]
    backwards = [x0 - 0.01, (y0 + y1) / 2, math.pi]
    found = overlaps(case, [record(0, "ours", poses=[far, pose]) for pose in (far, near, backwards)])
    assert found == pytest.approx([0.1855 - 2.109, 0.1855 - 0.119, 0.1855 + 0.099], abs=1e-4)


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
    assert set(words.MODELS) == set(MODELS)


@pytest.mark.parametrize("make", [figures._robustness, figures._mass])
def test_every_method_has_a_curve_of_its_own(make):
    names = ["unmodified", *(f"ours@0.0{i}" for i in range(10))]
    figure = make(load_case("case1"), {name: [record(0, name)] for name in names})
    curves = [line for line in figure.axes[0].lines if line.get_label() in names]
    assert [curve.get_label() for curve in curves] == names
    assert len({(curve.get_color(), curve.get_linestyle()) for curve in curves}) == len(names)
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == names


def test_every_method_is_described():
    assert set(words.METHODS) == set(METHODS)


def test_a_method_is_told_beside_ours_with_few_pairs_too():
    cost = {"pairs": 2, "mine": 5.0, "other": 4.0, "difference": 1.0, "difference_low": -1.0,
            "difference_high": 3.0, "share": 1.25, "low": None, "high": None}  # fmt: skip
    test = {"pairs": 4, "only": 1, "only_other": 0, "p": 1.0}
    found = {"other": "ours", "satisfied": test, "main_done": test, "kl": cost, "extra_steps": {"pairs": 0}}
    assert list(beside_ours({"beside_ours": {"lookahead": found, "hcd": found}})) == [
        "- lookahead, beside ours: KL a run 5.0 and 4.0, difference +1.0, n 2, ratio 1.25; extra steps in "
        "no pair of runs; rule 1 runs it alone, 0 the other alone, of 4, p = 1; main task 1 runs it alone, "
        "0 the other alone, of 4, p = 1."
    ]


def test_a_margin_is_compared_with_the_same_margin():
    there = ("ours", "ours@0.04/8", "ours@default", "paper", "lookahead")
    asked = ("paper@0.04/8", "paper", "paper@0.1", "ours@0.04/8", "adaptive@0.04/8", "ours")
    others = ["ours@0.04/8", "ours", "ours", "ours", "ours", None]
    assert [results._ours(name, there) for name in asked] == others
