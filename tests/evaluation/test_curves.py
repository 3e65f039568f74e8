"""Curves: which campaigns their points are, and the page and figure that are made of them."""

import pytest

from evaluation.curves import draw, draw_all, methods_of
from evaluation.experiment import Experiment, certifies, split
from specshield.errors import InputError


def test_a_threshold_is_of_each_step_or_of_the_episode_or_in_metres():
    step, episode, metres = (split(f"ours@{kind}/0.25")[1] for kind in ("step", "episode", "robustness"))
    assert (step.threshold, step.threshold_over, step.evaluation) == (0.25, "step", "feasibility")
    assert (episode.threshold, episode.threshold_over, episode.evaluation) == (0.25, "episode", "feasibility")
    assert (metres.threshold, metres.threshold_over, metres.evaluation) == (0.25, "step", "robustness")
    assert split("ours@robustness/-1")[1].threshold == -1.0
    assert split("ours@default")[1].threshold_over == "step"
    with pytest.raises(InputError, match="threshold"):
        split("ours@step/0")
    names = ["ours", "ours@step/1", "ours@step/0.9", "ours@episode/0.9", "ours@robustness/1", "unmodified"]
    assert [name for name in names if certifies(name)] == ["ours", "ours@step/1"]


def test_threshold_1_is_the_same_runs_for_step_and_episode():
    found = methods_of([1.0, 0.5], [0.1, -0.2])
    assert found[("step", 1.0)] == found[("episode", 1.0)] == "ours"
    assert next(iter(found.values())) == "unmodified"
    assert [d for kind, d in found if kind == "robustness"] == [-0.2, 0.1]


def test_the_page_has_a_row_a_point_and_what_is_kept_is_not_run_again(tmp_path):
    pytest.importorskip("matplotlib")
    experiments = [Experiment("case1", model="goal-seeker")]
    page = tmp_path / "curves.md"
    for _ in range(2):
        draw_all(experiments, [0.5, 1.0], [0.0], 2, tmp_path / "out", page, 1)
    text = page.read_text()
    assert "| case1, goal-seeker | step | 1 | 2 of 2 (15.8 to 100.0 %)" in text
    assert "| case1, goal-seeker | unmodified | - | 0 of 2 (0.0 to 84.2 %)" in text
    assert sum(line.startswith("| case1") for line in text.splitlines()) == 6
    assert "--thresholds 0.5,1 --metres 0 --runs 2 --seed 0 --out out/out" in text
    assert (tmp_path / "curves" / "curves.png").stat().st_size > 10_000
    (runs,) = (tmp_path / "out").glob("*/*/*/runs.jsonl")
    assert len(runs.read_text().splitlines()) == 2 * 5


def test_what_is_still_to_come_is_left_out_of_the_figure(tmp_path):
    pytest.importorskip("matplotlib")
    kept = {"count": 1, "of": 2, "low": 0.1, "high": 0.9}
    rows = [
        {"case": case, "model": model, "kind": kind, "threshold": 0.5, "satisfied": kept, "main_done": kept,
         "kl": 3.0, "kl_interval": [2.0, 4.0]}
        for case, model in (("case1", "learned"), ("case1", "bot"), ("case2", "learned"))
        for kind in ("step", "episode", "robustness")
    ]  # fmt: skip
    draw(rows, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 10_000
