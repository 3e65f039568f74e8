"""The page of worlds that are not as told: from commands to their figures, and from figures to its text."""

import json

import pytest
import typer

from evaluation.commands import uncertainty
from evaluation.uncertainty import figures, page, plan
from evaluation.uncertainty.aims import shortfalls
from evaluation.uncertainty.figures import Measured, tables
from evaluation.uncertainty.plan import Campaign
from specshield.errors import InputError

EVALUATED = """\
case1, gaussian, model goal-seeker, seed 0: F[0,60] A

| method | rule satisfied | main task done | KL a run [nats] |
| --- | --: | --: | --: |
| {} | {} of 200 (1 to 2 %) | {} of 200 (3 to 4 %) | {} (5.0 to 6.0) |

0:01
"""
WORLDS = """\
| robot | case | world | senses | kept of what the oracle can keep | 95 % interval | oracle |
|---|---|---|---|---|---|---|
| stretch | case1 | obstacle | scan | 57 of 59 | 88.3 to 99.6 % | 59 of 60 |
| stretch | case1 | obstacle | contact | 55 of 59 | 83.5 to 98.1 % | 59 of 60 |
"""
FORMS = """\
| what | rule | method | none, none | none, slip | default, none | default, slip | default, gaussian |
|---|---|---|--:|--:|--:|--:|--:|
| until | `(not B) U[0,80] A -> C` | planner | 20 (116) | 5 (1) | 20 (142) | 19 (146) | 20 (158) |
"""
FORMS_WORLDS = """\
| what | rule | method | shift, scan | shift, contact | person, scan | person, contact | p99 [ms] |
|---|---|---|--:|--:|--:|--:|--:|
| order | `F[0,70] (A and F[0,70] B)` | planner | 8 of 8 | 7 of 8 | 8 of 8 | 7 of 8 | 40 |
"""
THRESHOLDS = """\
| motions | asked | kept | 99 % interval | alone | worlds that can | kept there | 99 % interval |
|---|--:|--:|---|--:|--:|--:|---|
| noise | 0.95 | 0.827 | 0.7 to 0.9 | 0.010 | 13 | 0.991 | 0.9 to 1 |
| noise | 0.9 | 0.770 | 0.7 to 0.9 | 0.010 | 15 | 0.924 | 0.8 to 1 |
"""
SWITCHES = """\
| | rule | map | both | all |
|---|--:|--:|--:|--:|
| kept | 3 | 4 | 5 | 12 |
| BROKEN | 0 | 1 | 0 | 1 |
"""
MUJOCO = """\
| case | kept | 95 % interval | largest margin | what was broken |
|---|--:|--:|--:|---|
| case1 | 58 of 60 | 0.885 to 0.996 | 5.1 cm | F[0,60] A: 2 |

| case | motions | number | [mm] 50, 90, 99 % | [degrees] 50, 90, 99 % |
|---|---|--:|---|---|
| case1 | moves | 12 | 2.0, 3.0, 4.0 | 0.20, 0.30, 0.80 |
"""


def measured(printed, runs):
    return Measured(
        f"python -m benchmarks.forms --seed 0 --runs {runs}", "abcdef0", "2026-11-28", tables(printed)
    )


def evaluated(kept, main, kl, method="ours@default"):
    return measured(EVALUATED.format(method, kept, main, kl), 200)


@pytest.fixture
def found():
    return {
        "case1-none": evaluated(200, 200, 100.0),
        "case1-gaussian": evaluated(197, 194, 130.0),
        "case1-slip": evaluated(198, 193, 131.0),
        "case1-obstacle": measured(WORLDS, 60),
        "forms-worlds": measured(FORMS_WORLDS, 8),
        "forms": measured(FORMS, 20),
        "thresholds": measured(THRESHOLDS, 1000),
        "switches": measured(SWITCHES, 13),
        "mujoco": measured(MUJOCO, 60),
    }


def test_each_figure_below_its_aim_is_told_and_no_other(found):
    """By hand: 197 of 200 is less than 99 %, and 198 is not; 194 is 3 points below 200, and 193 is more; and
    131 is above 1.3 times 100. Of 59 runs, 57 is less than 97 %, and 55 not less than 92 %.
    """
    assert [line.partition(";")[0] for line in shortfalls(found)] == [
        "case1, gaussian: the rule is kept in 197 of 200 (95.7 to 99.7 %)",
        "case1, slip: the main task is done in 193 of 200 (92.9 to 98.6 %)",
        "case1: the KL of a run is 100.0 (5.0 to 6.0) nats in the row exact, and more than 1.3 times as much "
        "in these: slip (1.31 times).",
        "case1, obstacle, scan: the rule is kept in 57 of 59 (88.3 to 99.6 %)",
        "All these worlds together, scan: the rule is kept in 57 of 59 (88.3 to 99.6 %)",
        "order (planner), these worlds, contact: the rule is kept in 14 of 16 (61.7 to 98.4 %)",
        "until (planner), slips and noise: the rule is kept in 39 of 40 (86.8 to 99.9 %)",
        "MuJoCo, case1: the rule is kept in 58 of 60 (88.5 to 99.6 %)",
        "Switches: 1 are as they must not be (BROKEN).",
    ]
    found["thresholds"].tables[0][1]["kept there"] = "0.891"  # 668 of 750: less than was asked
    told = [line for line in shortfalls(found) if line.startswith("Threshold")]
    assert told == ["Threshold 0.9, noise: kept in 668 of 750 (86.6 to 91.2 %) where it can be had."]


def test_the_page_has_each_command_with_its_commit_and_names_what_was_not_measured(found, tmp_path):
    path = tmp_path / "results" / "page.md"
    page.write(path, found)
    text = path.read_text()
    assert "\npython -m benchmarks.forms --seed 0 --runs 200  # abcdef0, 2026-11-28\n" in text
    absent = text.partition("## What was not measured, or with fewer runs")[2].partition("\n## ")[0]
    assert "- `python -m evaluation worlds --case case2 --world person --seed 0 --runs 60`\n" in absent
    assert "--case case1 --world obstacle" not in absent
    assert (
        "- `python -m evaluation mujoco --case 1,2,drawn_3 --seed 0 --runs 100`: with `--runs 60` alone\n"
        in absent
    )
    assert (
        "| gaussian: off by sigma 0.01 m and 0.5 degrees | 197 of 200 (1 to 2 %) | 194 of 200 (3 to 4 %) |"
        in text
    )
    assert "| obstacle, contact | 55 of 59 (83.5 to 98.1 %) |" in text
    assert "| until: `(not B) U[0,80] A -> C` | planner | 20 (116) |" in text
    assert "| order: `F[0,70] (A and F[0,70] B)` | planner | 8 of 8 | 7 of 8 | 8 of 8 | 7 of 8 |\n" in text
    assert "The 95 % intervals: 8 of 8 (63.1 to 100.0 %); 7 of 8 (47.3 to 99.7 %)." in text
    assert "- default, slips: 19 of 20 (75.1 to 99.9 %)\n" in text
    assert "| noise | 0.95 | 827 of 1000 (80.2 to 85.0 %) | 13 | 644 of 650 (98.0 to 99.7 %) |" in text
    assert "As it should be: 12 of 13 (64.0 to 99.8 %)." in text
    assert "{" not in text


def test_a_campaign_is_kept_taken_up_and_told_where_it_fails(tmp_path, monkeypatch, capfd):
    words = "evaluation evaluate --case case1 --noise none --model goal-seeker --methods ours --seed 0"
    there = Campaign("noise", "case1-none", words, 40, keeps=True)
    gone = Campaign("noise", "case1-slip", words.replace("case1", "case9"), 40, keeps=True)
    monkeypatch.setattr(plan, "LEAST", 2)
    monkeypatch.setattr(figures, "plan", lambda seed=0: [gone, there])
    kept, failed = figures.carry_out(tmp_path, [], 0.001, 0, 1)
    assert failed == 1
    assert "there is no case 'case9'" in capfd.readouterr().err
    assert list(kept) == ["case1-none"]
    (row,) = kept["case1-none"].tables[0]
    assert row["rule satisfied"] == "2 of 2 (15.8 to 100.0 %)"
    written = json.loads((tmp_path / "case1-none.json").read_text())
    assert written["command"] == f"python -m {words} --runs 2"
    assert written["commit"] == figures.current_commit()
    monkeypatch.setattr(figures, "run", None)
    assert figures.carry_out(tmp_path, ["worlds"], 0.001, 0, 1) == (kept, 0)
    monkeypatch.setattr(figures, "plan", lambda seed=0: [there])
    assert figures.carry_out(tmp_path, [], 0.001, 0, 1) == (kept, 0)


def test_the_plan_names_each_campaign_once_and_shortens_it():
    found = list(plan.plan(3))
    assert len({each.name for each in found}) == len(found)
    assert {each.part for each in found} == set(plan.PARTS)
    assert all("--seed 3" in each.words for each in found)
    assert found[0].command(0.1).endswith("--methods ours,ours@default --seed 3 --runs 20")


def test_a_part_is_measured_anew_and_the_rest_of_the_page_stays(found, tmp_path):
    path, out = tmp_path / "page.md", tmp_path / "out"
    page.write(path, found)
    figures.keep_beside(path, found)
    before = path.read_text()
    mended = tables(SWITCHES.replace("BROKEN | 0 | 1 | 0 | 1", "BROKEN | 0 | 0 | 0 | 0"))
    newer = Measured("python -m benchmarks.switches --seed 0 --switches 200", "abcdef1", "2026-11-30", mended)
    out.mkdir()  # it holds what was measured anew, so that nothing is run
    (out / "switches.json").write_bytes(figures.ONE.dump_json(newer))
    with pytest.raises(typer.Exit):
        uncertainty("switches", 1.0, 0, out, path, 1)
    lines = set(path.read_text().splitlines())
    gone = [line for line in before.splitlines() if line not in lines]
    assert any("BROKEN" in line for line in gone)
    assert not [line for line in gone if "MuJoCo" in line or "case1" in line or "until" in line]
    assert figures.beside(path) == {**found, "switches": newer}


def test_figures_that_something_else_wrote_are_refused(tmp_path):
    (tmp_path / "page.json").write_text('{"mujoco": {"command": 1}}')
    with pytest.raises(InputError, match=r"page\.json.*remove it to measure them anew"):
        figures.beside(tmp_path / "page.md")
