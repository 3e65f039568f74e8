"""benchmarks/reliability: a harness that found nothing has to be one that would have found it."""

import json
import random
import threading
from dataclasses import replace

import pytest

from benchmarks.reliability import report
from benchmarks.reliability.faults.check import COUNTS, check
from benchmarks.reliability.fuzz import shards
from benchmarks.reliability.robots import Episode, Robot, find_starts
from specshield.errors import SpecshieldError


@pytest.fixture(scope="module")
def episode(server):
    (start,) = find_starts(server.url, 1)
    robot = Robot("checked", [server.url], [start], 1, threading.Event(), sdk=False)
    made = Episode("checked-0", 7, start)
    robot._by_hand(made)
    made.exchanges = robot.tries
    return made


def counts(server, episode):
    found = check(server.url, server.url, [episode])
    return {name: found[name] for name in COUNTS if found[name]}


def test_an_episode_that_nothing_happened_to_is_clean(server, episode):
    assert episode.verdict == "satisfied"
    assert episode.steps > 50
    assert counts(server, episode) == {}


def test_what_was_lost_changed_doubled_violated_or_stuck_is_counted(server, episode):
    tried = episode.exchanges
    first = next(i for i, each in enumerate(tried) if each.path.endswith("/steps"))
    step = tried[first]
    altered = replace(step, content=step.content.replace(b"shaped", b"shapes"))
    changed = [*tried[:first], altered, *tried[first + 1 :]]
    assert counts(server, replace(episode, exchanges=changed)) == {"changed": 1, "decided_otherwise": 1}
    assert counts(server, replace(episode, exchanges=[*tried, altered]))["doubled"] == 1
    assert counts(server, replace(episode, exchanges=tried[: len(tried) // 2]))["doubled"] > 1
    assert counts(server, replace(episode, id="gone"))["lost"] == episode.steps
    assert counts(server, replace(episode, verdict="violated")) == {"violated": 1}
    assert counts(server, replace(episode, verdict=None)) == {"stuck": 1}


@pytest.mark.parametrize("name", ["formula", "map_server", "occupancy_grid", "procthor"])
def test_fuzzed_inputs_are_the_same_each_time_and_break_no_reader(name):
    target, taken = shards.TARGETS[name](), 0
    for i in range(300):
        content = target.make(random.Random(i))
        assert content == target.make(random.Random(i))
        try:
            target.feed(content)
            taken += 1
        except SpecshieldError:
            continue
    assert 0 < taken < 300


def test_a_row_of_faults_that_is_measured_anew_takes_its_place_on_the_page_and_the_others_stay(tmp_path):
    page, out = tmp_path / "page.md", tmp_path / "out"
    page.write_text(report.PAGE.read_text())
    report.run(out, page)
    assert page.read_text() == report.PAGE.read_text()
    what = "SIGKILL of the process that trains"
    kept = [line for line in page.read_text().splitlines() if line.startswith("| ")]
    (row,) = (line for line in kept if line.startswith(f"| {what}"))
    out.mkdir()
    times = {"median": 7.0, "max": 8.0}
    figures = {"what": row.split(" | ")[0].removeprefix("| "), "kills": 3, "failed_without_reason": 1}
    figures |= {"failed_after_s": times, "trains_again_after_s": times}
    (out / "fault-run_killed.json").write_text(json.dumps(figures))
    report.run(out, page)
    anew = [line for line in page.read_text().splitlines() if line.startswith("| ")]
    assert len(anew) == len(kept)
    (new,) = set(anew) - set(kept)
    assert new.startswith(f"| {what}")
    assert new.endswith(" | 3 | 1 | 7.0 / 8.0 | 7.0 / 8.0 |")
