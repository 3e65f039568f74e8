"""A robot found where a broken G forbids it to be is led out by the shortest way, and then keeps the rest."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest

from specshield.policy import planner
from specshield.robot.unicycle import simulate
from specshield.shield.episode import decide, make_shield
from specshield.sim.cases import load_case, shipped

CASE = load_case("case2")
ELSEWHERE = (5.0, 4.7, 0.0)


def inside(pose):
    return 6.2 < pose[0] < 7.1 and 4.1 < pose[1] < 5.3


def visits(poses, centre, first, last):
    return any(math.dist(p[:2], centre) < 0.6 for p in poses[first : last + 1])


def fewest_steps_out(body, pose):
    for k in range(1, 5):
        reached = np.empty((k, 3))
        for motions in product(range(len(body.translate)), repeat=k):
            simulate(body, np.array(pose), np.array(motions), reached)
            if not inside(reached[-1]):
                return k
    raise AssertionError("more than four steps")


@pytest.mark.parametrize("method", ["reachability", "dqn", "planner"])
@pytest.mark.parametrize("pose", [(6.65, 4.7, 0.0), (6.45, 4.7, 0.0), (6.7, 5.2, -0.5)])
@pytest.mark.parametrize("when", [0, 20])
def test_it_leaves_at_once_and_keeps_the_rest(method, pose, when):
    policy = planner.synthesise(CASE.task) if method == "planner" else shipped(CASE, method)
    shield, random = make_shield([policy]), np.random.default_rng(3)
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
