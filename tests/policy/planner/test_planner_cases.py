"""The planner in the case apartments: a rule of each shape that has no tables, kept against a model."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.rules import RULES, feasible_starts, make, run
from specshield.episode import make_shield
from tests.oracles.brute_stl import brute_robustness
from tests.oracles.judge import signed_distance

SHAPES = ("patrol", "reactive", "until", "until, round what is in the way", "disjunction", "nested")


@pytest.mark.parametrize("name", SHAPES)
def test_an_episode_of_each_shape_keeps_the_rule(name):
    case, policy = make(name)
    assert policy.card["metrics"]["feasible_start"] > 0.9
    assert len(policy.weights()) < 10e6
    shield, refused = make_shield([policy]), []
    pose = next(feasible_starts(shield, np.random.default_rng(7), refused))
    episode = run(shield, case, pose, seed=7)
    assert episode.spec_status == "satisfied"
    assert not episode.modes["fallback"]
    regions = case.spec["regions"]
    samples = {
        region: [signed_distance(regions[region], x, y) for x, y, _ in episode.poses] for region in regions
    }
    assert brute_robustness(RULES[name][1], {**samples, "event": episode.events}) > 0.0
    if name == "reactive":
        assert max(episode.events) == 1.0
