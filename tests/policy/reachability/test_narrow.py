"""Predicates that the lattice can hardly see: small places, strips, headings of no crossing, docking."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.exact import NOWHERE, Goal, fewest_steps
from benchmarks.narrow import runs
from specshield.episode import make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.methods import load_policy
from specshield.policy.planner.policy import synthesise as plan
from specshield.policy.reachability.policy import synthesise
from specshield.robot import STRETCH
from specshield.robot.dynamics import make_body
from specshield.sim.cases import load_case
from specshield.task import make_task

PLACE = Goal(x=4.9, y=5.0, radius=0.05)
DOCK = Goal(x=4.9, y=5.0, radius=0.4, theta=(0.86, 0.94))
WRAP = Goal(theta=(-math.inf, -3.1))
ASKED = {
    "two moves lead onto its centre": (PLACE, 60, 0, (4.5, 5.0, 0.0)),
    "a place from another room": (PLACE._replace(radius=0.02), 90, 0, (1.5, 3.5, 2.0)),
    "a window of headings": (Goal(theta=(0.002, 0.102)), 30, 0, (4.5, 5.0, 1.1)),
    "a window at the wrap": (WRAP, 30, 0, (4.5, 5.0, 0.02)),
    "docking": (DOCK, 120, 0, (4.5, 5.0, 0.2)),
    "docking, to stay": (DOCK, 90, 10, (2.0, 5.0, -1.0)),
    "a strip": (Goal(xs=(4.99, 5.02)), 60, 0, (3.0, 5.0, -2.2)),
}


def task_of(goal, by, dwell=0):
    inner = f"G[0,{dwell}] {goal.formula()}" if dwell else goal.formula()
    dock = {"Dock": {"type": "circle", "center": [goal.x, goal.y], "radius": goal.radius}}
    regions = dock if goal.radius < math.inf else {}
    return make_task(load_case("case1").task.grid, STRETCH, f"F[0,{by}] {inner}", regions)


@pytest.mark.parametrize(("goal", "by", "dwell", "pose"), ASKED.values(), ids=list(ASKED))
def test_what_the_motions_can_reach_is_accepted_and_kept(goal, by, dwell, pose):
    policy = synthesise(task_of(goal, by, dwell))
    shield = make_shield([policy])
    start(shield, pose)
    kept, _ = runs(shield, np.array(pose), goal, dwell, by, np.random.default_rng(0))
    assert kept
    assert policy.narrow.tolist() == [True]


def test_a_heading_that_no_turn_leads_to_is_refused():
    """From heading 0 the turns of 6 and 30 degrees lead to 48 and to 54 degrees: 0.838 and 0.942."""
    shield = make_shield([synthesise(task_of(DOCK, 30))])
    with pytest.raises(InfeasibleStart):
        start(shield, (4.5, 5.0, 0.0))


@pytest.mark.parametrize("make", [synthesise, plan], ids=["reachability", "planner"])
def test_the_share_of_feasible_starts_is_over_real_headings(make):
    """A window of 3 degrees lies between the headings of two starts in four: turns go by 6 degrees."""
    goal, random = Goal(theta=(1.0, 1.0 + math.radians(3))), np.random.default_rng(5)
    policy = make(task_of(goal, 20))
    share = policy.card["metrics"]["feasible_start"]
    body = make_body(STRETCH, policy.task.grid)
    found = [
        fewest_steps(body, goal, 4.5, 5.0, h, 20, 10_000, NOWHERE) >= 0 for h in random.uniform(-3, 3, 400)
    ]
    assert abs(share - np.mean(found)) < 0.25  # 50 starts or more: three standard deviations are 0.21
    assert 0.3 < share < 0.7


def test_a_start_where_the_arithmetic_is_not_finite_is_no_feasible_one():
    """And no reason to make no policy: half of all headings are fine."""
    base = load_case("case1").task
    policy = synthesise(make_task(base.grid, STRETCH, "F[0,5] 1 / (abs(theta) - theta) > 0"))
    assert 0.2 < policy.card["metrics"]["feasible_start"] < 0.8


def test_such_a_policy_comes_back_from_its_files():
    policy = synthesise(task_of(DOCK, 60))
    again = load_policy(policy.weights(), policy.card, policy.task)
    history = np.array([[4.5, 5.0, 0.2]])
    np.testing.assert_array_equal(
        policy.propose(history, {}, 0.0).motions, again.propose(history, {}, 0.0).motions
    )


@pytest.mark.parametrize("name", ["case1", "case2"])
def test_the_lattice_sees_the_rules_of_the_cases(name):
    assert not synthesise(load_case(name).task).narrow.any()


def test_a_signal_near_its_bound_is_no_narrow_place():
    """The policy finds as much as for the rule without it: no motion leads nearer to what a signal is."""
    base = load_case("case2")
    without, told = (
        synthesise(
            make_task(base.task.grid, STRETCH, f"F[0,60] Region1{more}", base.spec["regions"], signals=s)
        )
        for more, s in (("", {}), (" and G[0,60] charge > 0.1", {"charge": 0.115}))
    )
    assert not told.narrow.any()
    shares = [policy.card["metrics"]["feasible_start"] for policy in (without, told)]
    assert shares[0] == shares[1] > 0.5
