"""A robot found where a broken G forbids it to be is led out by the shortest way, and then keeps the rest."""

from __future__ import annotations

import math
from functools import cache
from itertools import product

import numpy as np
import pytest

from evaluation.shipped import shipped
from specshield.episode import Config, decide, make_shield
from specshield.policy.planner import policy as planner
from specshield.policy.reachability import policy as reachability
from specshield.robot import robot_from_json
from specshield.robot.dynamics import motion_count, simulate
from specshield.shield.uncertainty import Uncertainty
from specshield.sim.cases import load_case
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid

CASE = load_case("case2")
ELSEWHERE = (5.0, 4.7, 0.0)


def inside(pose):
    return 6.2 < pose[0] < 7.1 and 4.1 < pose[1] < 5.3


def visits(poses, centre, first, last):
    return any(math.dist(p[:2], centre) < 0.6 for p in poses[first : last + 1])


def fewest_steps_out(body, pose):
    for k in range(1, 5):
        reached = np.empty((k, 3))
        for motions in product(range(motion_count(body)), repeat=k):
            simulate(body, np.array(pose), np.array(motions), reached)
            if not inside(reached[-1]):
                return k
    raise AssertionError("more than four steps")


@cache
def policy_of(method):
    return planner.synthesise(CASE.task) if method == "planner" else shipped(CASE, method)


@pytest.mark.parametrize("method", ["reachability", "dqn", "planner"])
@pytest.mark.parametrize(
    ("pose", "when"),
    [((6.65, 4.7, 0.0), 0), ((6.65, 4.7, 0.0), 20), ((6.45, 4.7, 0.0), 0), ((6.7, 5.2, -0.5), 20)],
)
def test_it_leaves_at_once_and_keeps_the_rest(method, pose, when):
    shield, random = make_shield([policy_of(method)]), np.random.default_rng(3)
    x, history, carry = ELSEWHERE, [], None
    for t in range(CASE.task.horizon):
        history.append(pose if t == when else x)  # a localisation that jumps
        decision = decide(shield, history, random.normal(0, 1, 20) - 9.0 * (np.arange(20) == 4), carry=carry)
        if t >= when:
            assert (decision.mode, decision.reason) == ("violated", None)
            assert not decision.distribution[np.array(decision.j_values) == 0.0].any()
        x, carry = tuple(decision.next_poses[decision.action]), decision.carry
    history.append(x)
    assert sum(map(inside, history[when:])) == fewest_steps_out(shield.body, pose)
    assert visits(history, (1.5, 5.9), 50, 100)
    assert visits(history, (5.5, 7.4), 100, 150)


def test_where_the_rest_is_lost_it_still_leaves():
    task = CASE.task
    policy = shipped(CASE, "reachability")
    shield = make_shield([policy])
    late = [ELSEWHERE] * 100 + [(6.65, 4.7, 0.0)]  # Region1 and Region2 are missed
    history, carry = late, None
    for _ in range(5):
        decision = decide(shield, history, np.zeros(20), carry=carry)
        assert decision.mode == "violated"
        history, carry = [*history, tuple(decision.next_poses[decision.action])], decision.carry
    assert task.horizon > len(history)
    assert not inside(history[-1])


def test_a_visit_that_would_keep_it_inside_is_not_asked_for_and_the_answer_says_so():
    beside = {"type": "circle", "center": [3.2, 2.5], "radius": 0.15}
    task = make_task(ROOM, BODY, "G[0,12] not K and F[0,6] B", {"K": REGIONS["K"], "B": beside})
    for x, told in ((2.9, False), (2.1, True)):  # beside the way out, or on the other side of the region
        shield = make_shield([planner.synthesise(task)], Config(uncertainty=Uncertainty()))
        decision = decide(shield, [(x, 2.5, math.pi)], np.zeros(5))
        assert decision.mode == "violated"
        assert any("keeps F[0,6] B beside that" in said for said in decision.warnings) == told


ROOM = OccupancyGrid(np.zeros((120, 120), bool), 0.05)
BODY = robot_from_json(
    {
        "footprint": {"radius": 0.15},
        "actions": [
            {"name": "stay"}, {"name": "forward", "translate": 0.2}, {"name": "back", "translate": -0.2},
            {"name": "left", "rotate": math.pi / 6}, {"name": "right", "rotate": -math.pi / 6},
        ],
    }
)  # fmt: skip
REGIONS = {
    "K": {"type": "rectangle", "min": [2.0, 2.0], "max": [3.0, 3.0]},
    "Beside": {"type": "rectangle", "min": [3.001, 1.5], "max": [4.0, 3.5]},
    "A": {"type": "rectangle", "min": [2.0, 2.0], "max": [3.0, 3.0]},
    "Hall": {"type": "rectangle", "min": [0.5, 0.2], "max": [5.8, 5.8]},
}


def led_out(formula, pose, steps, signals=None):
    """At which of some steps the robot is in K, or in what lies beside it, and the last decision."""
    task = make_task(ROOM, BODY, formula, REGIONS, signals=signals)
    shield, history, carry = make_shield([reachability.synthesise(task)]), [(1.0, 1.0, 0.0), pose], None
    given = {name: np.full(steps + 2, value) for name, value in (signals or {}).items()}
    decisions = []
    for _ in range(steps):
        now = {name: values[: len(history)] for name, values in given.items()}
        decision = decide(shield, history, np.zeros(5), signals=now, carry=carry)
        decisions.append(decision)
        history, carry = [*history, tuple(decision.next_poses[decision.action])], decision.carry
    within = [2 < x < 3 and 2 < y < 3 for x, y, _ in history[1:]]
    beside = [3.001 < x < 4 and 1.5 < y < 3.5 for x, y, _ in history[1:]]
    return within, beside, decisions


@pytest.mark.parametrize(
    ("formula", "signals"),
    [
        ("G[0,40] not K", None),
        ("not F[0,40] K", None),
        ("G[0,38] G[0,2] not K", None),
        ("G[0,2] not A and G[0,40] not K", None),  # one window ends before the robot can be out
        ("G[0,40] (bat > 0.2) and G[0,40] not K", {"bat": 0.1}),  # lost for good: the other is not
    ],
)
def test_no_other_rule_keeps_it_inside(formula, signals):
    within, _, decisions = led_out(formula, (2.5, 2.5, 0.0), 6, signals)
    assert within == [True, True, True, False, False, False, False]
    assert all(d.mode in ("violated", "fallback") for d in decisions)


def test_it_is_not_led_through_another_forbidden_region():
    within, beside, decisions = led_out("G[0,60] not K and G[0,60] not Beside", (2.75, 2.5, 0.0), 8)
    assert within == [True] * 4 + [False] * 5
    assert not any(beside)
    assert all(d.reason is None for d in decisions)


def test_it_heads_out_of_a_region_that_is_too_large_to_search():
    actions = [{"name": "stay"}, {"name": "forward", "translate": 0.05}, {"name": "back", "translate": -0.05}]
    slow = robot_from_json({"footprint": {"radius": 0.15}, "actions": actions})
    task = make_task(ROOM, slow, "G[0,90] not Hall", REGIONS)
    shield, history, carry = make_shield([reachability.synthesise(task)]), [(3.0, 3.0, 0.0)], None
    for _ in range(60):
        decision = decide(shield, history, np.zeros(3), carry=carry)
        history, carry = [*history, tuple(decision.next_poses[decision.action])], decision.carry
    assert [x > 0.5 for x, _, _ in history].index(False) == 51  # 2.5 m, and not on the edge
