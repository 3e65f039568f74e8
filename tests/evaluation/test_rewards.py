"""Trainings side by side: each is made once, and the page says what came of it."""

import pytest

pytest.importorskip("torch")

from evaluation.rewards import all_of, compare


def test_every_case_and_reward_begins_with_the_first_seed():
    found = all_of("1,2", "paper,progress", [3, 4], 100)
    assert [each.seed for each in found] == [3] * 4 + [4] * 4
    assert {(each.case, each.reward) for each in found[:4]} == {
        (case, reward) for case in ("case1", "case2") for reward in ("paper", "progress")
    }


def test_what_was_trained_is_not_trained_again(tmp_path):
    page, out = tmp_path / "rewards.md", tmp_path / "out"
    compare(all_of("1", "paper", [0], 2), 1, out, page)
    weights = out / "case1-paper-0-2" / "policy.safetensors"
    written, made = page.read_text(), weights.stat().st_mtime_ns
    runs = weights.with_name("runs.jsonl")
    kept = runs.read_text()
    runs.write_text(kept[:-9])  # killed while it wrote: that run is made again
    compare(all_of("1", "paper", "0", 2), 1, out, page)
    assert runs.read_text().count("\n") == 1
    assert (page.read_text(), weights.stat().st_mtime_ns) == (written, made)
    (row,) = (line for line in written.splitlines() if line.startswith("| case1 | paper | 0 | 2 |"))
    assert row.count("%") == 4
    assert "eq. 5 with the funnels of its Table I" in written
    assert "--case case1 --reward paper --seeds 0 --updates 2 --runs 1 --out out/out" in written
