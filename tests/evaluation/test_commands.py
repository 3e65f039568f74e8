"""The commands that evaluation adds to `specshield`, as a user runs them."""

import json
import re
import subprocess
import sys
from importlib.metadata import entry_points

import pytest
import typer

from evaluation import commands, habits, jobs, plan
from tests.serving import run_specshield


def specshield(*arguments, code=0):
    done = run_specshield(*arguments)
    assert done.returncode == code, done.stderr
    return done


def test_the_entry_points_name_what_there_is():
    """Without them `specshield` would know neither the commands nor the queue."""
    found = {each.name: each.load() for each in entry_points(group="specshield.commands")}
    assert found.items() >= {"evaluate": commands.evaluate, "report": commands.report}.items()
    queues = {each.name: each.load() for each in entry_points(group="specshield.queues")}
    assert queues[jobs.QUEUE] is jobs.run_chunk
    assert "evaluate" in specshield("--help").stdout


def test_it_runs_without_being_installed_too():
    told, refused = (
        subprocess.run([sys.executable, "-m", "evaluation", *words], capture_output=True, text=True)
        for words in (["--help"], ["evaluate", "--case", "9"])
    )
    assert "evaluate" in told.stdout
    assert refused.returncode == 2
    assert "one of case1, case2" in refused.stderr


def test_without_mujoco_it_is_said_how_to_get_it():
    hidden = (
        "import sys; sys.modules['mujoco'] = None; sys.argv = ['evaluation', 'mujoco', '--runs', '1'];"
        "import runpy; runpy.run_module('evaluation', run_name='__main__')"
    )
    refused = subprocess.run([sys.executable, "-c", hidden], capture_output=True, text=True)
    assert refused.returncode == 2
    (line,) = refused.stderr.splitlines()
    assert "pip install -e './evaluation[mujoco]'" in line


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("rewards --seeds 0,1.7", "--seeds: not all are whole numbers"),
        ("rewards --seeds 0,-1", "--seeds: not all are whole numbers"),
        ("rewards --seeds nan", "--seeds: not all are whole numbers"),
        ("rewards --case 1,9", "there is no case 'case9'"),
        ("curves --case 1,9", "there is no case 'case9'"),
        ("rivals --case case1,case9", "there is no case 'case9'"),
        ("rivals --model learned,nobody", "there is no model 'nobody'"),
    ],
)
def test_what_cannot_be_run_is_refused_before_the_rest_is_run(tmp_path, words, told):
    name, option, value = words.split()
    out = tmp_path / "out"
    refused = specshield(name, option, value, "--out", str(out), "--page", str(tmp_path / "page.md"), code=2)
    assert told in refused.stderr
    assert not out.exists()


def test_evaluate_prints_the_table_keeps_its_results_and_takes_them_up(tmp_path):
    arguments = ["evaluate", "--case", "1", "--runs", "2", "--methods", "unmodified,ours"]
    arguments += ["--processes", "1", "--out", str(tmp_path)]
    done = specshield(*arguments)
    assert "case1, none, model " in done.stdout
    (row,) = (line for line in done.stdout.splitlines() if line.startswith("| ours |"))
    assert "2 of 2 (15.8 to 100.0 %)" in row
    folder = tmp_path / "case1" / "none"
    names = ["experiment.json", "results.json", "runs.jsonl", "table.md"]
    assert sorted(path.name for path in folder.iterdir()) == names
    kept = (folder / "runs.jsonl").read_text()
    figures = json.loads(specshield(*arguments, "--json").stdout)
    assert (folder / "runs.jsonl").read_text() == kept
    assert [one["satisfied"]["count"] for one in figures["methods"]] == [0, 2]
    assert [record["run"] for record in figures["records"]] == [0, 0, 1, 1]
    (row,) = re.findall(r"^\| ours \|.*", specshield(*arguments, "--runs", "1").stdout, re.MULTILINE)
    assert "1 of 1 (2.5 to 100.0 %)" in row  # of the runs that were asked for
    assert "2 of 2 (15.8 to 100.0 %)" in (folder / "table.md").read_text()


def test_report_writes_a_page_and_its_pictures(tmp_path):
    pytest.importorskip("matplotlib")
    kept = tmp_path / "results" / "case2" / "gaussian"
    kept.mkdir(parents=True)
    calibration = {"asked": "/4", "margin": 0.0391, "rounded": 0.04, "runs": 60}
    (kept / "calibration.json").write_text(json.dumps({"conformal/4": calibration}))
    arguments = ["--runs", "2", "--processes", "1", "--out", str(tmp_path / "results")]
    specshield("evaluate", "--case", "2", "--methods", "unmodified,simplex", *arguments)
    specshield("evaluate", "--case", "2", "--methods", "ours@conformal/4", "--noise", "gaussian", *arguments)
    page = tmp_path / "page.md"
    written = specshield("report", str(tmp_path / "results"), "--out", str(page))
    assert written.stdout == f"page: {page}\n"
    text = (tmp_path / "page" / "noise.md").read_text()
    assert "| gaussian | ours@0.04/4 | 2 of 2 (15.8 to 100.0 %)" in text
    assert "ours@0.04/4: 0.0391 m from 60 other runs; it covered every step of" in text
    text = (tmp_path / "page" / "cases.md").read_text()
    assert "| case2, learned | unmodified | 0 % | 99 % | 0 of 2 (0.0 to 84.2 %) |" in text
    for name in ("ways", "robustness", "mass", "modes"):
        assert f"![{name} of case2, learned](case2/{name}.png)" in text
        assert (tmp_path / "page" / "case2" / f"{name}.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--case", "case9"], "one of case1, case2"),
        (["--case", "1", "--methods", "ours,nope"], "adaptive, lookahead; or NAME@METRES, "),
        (["--case", "1", "--methods", "ours@nope"], "NAME@step/SHARE or NAME@robustness/METRES, with NAME"),
        (["--case", "house"], "--house drawn_0 with --case house"),
        (["--case", "house", "--house", "house_0"], 'prior.load_dataset("procthor-10k")'),
        (
            ["--case", "house", "--house", "house_0", "--houses", "/nowhere"],
            "no house '/nowhere/house_0.json'",
        ),
    ],
)
def test_a_mistake_is_told_in_a_line(arguments, said):
    done = specshield("evaluate", *arguments, code=2)
    (line,) = done.stderr.splitlines()
    assert said in line


def test_a_case_that_is_not_is_told_before_worlds_are_run(tmp_path):
    """It came after the runs of the cases before it; and 1 was no name of case1, as it is elsewhere."""
    asked = ("--case", "1,9", "--world", "told", "--sensing", "none", "--runs", "1", "--processes", "1")
    refused = specshield("worlds", *asked, "--out", str(tmp_path), code=2)
    assert not refused.stdout
    (line,) = refused.stderr.splitlines()
    assert line.startswith("there is no case 'case9'")
    house = ("--case", "0-house.json", "--world", "told", "--sensing", "none", "--runs", "1")
    (line,) = specshield("worlds", *house, "--out", str(tmp_path), code=2).stderr.splitlines()
    assert line.startswith("there is no house '0-house.json'")  # a number at its beginning is no case's


def test_results_say_that_there_are_no_houses(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plan, "carry_out", lambda *_: 0)
    for only, said in (("", True), ("houses", True), ("cases", False)):
        with pytest.raises(typer.Exit):
            commands.results(tmp_path, tmp_path / "page.md", tmp_path / "typo", only, 1.0, 1)
        told = f"no ProcTHOR houses are in {tmp_path / 'typo'}: they are left out\n"
        assert capsys.readouterr().err == told * said


@pytest.mark.parametrize(
    ("command", "option", "given"),
    [
        ("worlds", "--world", "obstacle,nope"),  # which would be measured, as a world like the one told
        ("worlds", "--sensing", "nope"),
        ("results", "--only", "nope"),
        ("curves", "--metres", "0.1,nope"),
        ("rewards", "--reward", "paper,nope"),
    ],
)
def test_a_name_that_nothing_has_is_refused(command, option, given, tmp_path):
    refused = specshield(command, option, given, "--out", str(tmp_path), code=2)
    (line,) = refused.stderr.splitlines()
    assert line.startswith(f"{option}: ")
    assert "nope" in line


@pytest.mark.parametrize("command", ["rivals", "habits", "rewards", "curves", "results"])
def test_a_page_that_cannot_be_written_is_told_before_anything_runs(command, tmp_path):
    """It was told after hours, when the runs were made and the page was to be written."""
    (tmp_path / "file").touch()
    for page, said in ((tmp_path / "file" / "page.md", "File exists"), (tmp_path, "this is a folder")):
        asked = ("--page", str(page), "--out", str(tmp_path / "out"))
        refused = specshield(command, *asked, code=2)
        assert not refused.stdout
        (line,) = refused.stderr.splitlines()
        assert line.startswith("--page")
        assert said in line
    assert not (tmp_path / "out").exists()


def test_the_folder_of_a_page_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(habits, "measure", lambda *_: None)
    commands.habits(1, 0, tmp_path, tmp_path / "new" / "page.md", 1)
    assert (tmp_path / "new").is_dir()
