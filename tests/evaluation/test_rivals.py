"""Whether look-ahead stays is decided by a rule that was set before the runs."""

import pytest

from evaluation.rivals import METHODS, tables, verdict
from tests.evaluation.test_statistics import record


def found(kl, ended_at, runs=20):
    """One model in one case: each method's KL and the step at which it did the main task, in every run."""
    return {
        ("bot", "case1"): [
            record(i, method, kl=kl.get(method, 10.0), ended_at=ended_at.get(method, 100))
            for i in range(runs)
            for method in METHODS
        ]
    }


@pytest.mark.parametrize(
    ("kl", "ended_at", "met"),
    [
        ({"ours": 50.0, "lookahead": 7.0}, {}, (True, True, None)),  # no run to judge the last by
        ({"lookahead": 8.1}, {}, (False, True, None)),  # the best slack has 10
        ({"lookahead": 7.9}, {"adaptive@0/25": 99}, (True, False, None)),
        ({"ours": 0.5, "lookahead": 0.3}, {}, (True, True, True)),
        ({"ours": 0.5, "lookahead": 1.6}, {}, (False, True, False)),
    ],
)
def test_each_part_of_the_rule_is_judged_by_itself(kl, ended_at, met):
    _, said = verdict(found(kl, ended_at), 600)
    parts = said.split("\n")
    assert tuple("**met**" in part for part in parts) == tuple(each is True for each in met)
    assert tuple("**not met**" in part for part in parts) == tuple(each is False for each in met)


def test_a_rule_that_costs_hardly_anything_is_judged_without_a_ratio():
    """As in some houses. It ended in a traceback, after all runs were made."""
    free = dict.fromkeys(METHODS, 0.0)
    _, said = verdict(found(free, {}), 600)
    assert "look-ahead's is 0.00 beside the 0.00 of the best slack's" in said
    one = found(free, {})
    for method in METHODS:
        one["bot", "case1"].append(record(20, method, kl=8.0, ended_at=100))
    _, said = verdict(one, 600)
    assert "look-ahead's is 1.00 (not bounded) of the best slack's" in said


def test_sums_weigh_models_and_cases_alike():
    both = found({"ours": 4.0}, {"ours": 30}) | {
        ("rover", "case2"): found({"ours": 6.0}, {}, 40)["bot", "case1"]
    }
    kl, steps, _, apart = tables(both, 600)
    assert "| **sum** | **20.0** | **10.0** |" in kl
    assert "| **sum** | **200.0** | **130.0** |" in steps
    assert "| bot, case1 | 10.0 (10.0 to 10.0) | 4.0 (4.0 to 4.0) |" in kl
    assert "| bot, case1 | +6.0 (+6.0 to +6.0), n 20 | +70.0 (+70.0 to +70.0), n 20 |" in apart
