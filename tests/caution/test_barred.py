"""Motions that are known to lead nowhere from some poses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from specshield.caution.surprise.barred import in_vain, is_barred
from specshield.episode import Config, decide, make_shield
from specshield.policy.planner import policy as planner
from specshield.policy.reachability import policy as reachability
from specshield.shield.uncertainty import Uncertainty
from tests.policy.rooms import flat

BARRED = np.array([[1.0, 2.0, math.pi, 3.0, 0.05, 0.1], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])


def test_a_motion_is_barred_at_its_pose_and_near_it():
    assert is_barred(BARRED, 1.0, 2.0, math.pi, 3)
    assert is_barred(BARRED, 1.03, 2.03, -math.pi + 0.09, 3)  # 4.2 cm off; headings go round
    assert not is_barred(BARRED, 1.04, 2.04, math.pi, 3)  # 5.7 cm off
    assert not is_barred(BARRED, 1.0, 2.0, math.pi - 0.11, 3)
    assert not is_barred(BARRED, 1.0, 2.0, math.pi, 1)
    assert is_barred(BARRED, 0.0, 0.0, 0.0, 1)
    assert not is_barred(np.empty((0, 6)), 0.0, 0.0, 0.0, 1)


def test_a_future_is_in_vain_that_goes_by_a_barred_motion_at_any_step_or_before_it_leads_away():
    here, there = [0.0, 0.0, 0.0], [1.0, 2.0, math.pi]
    motions = np.array([[1, 0], [0, 3], [0, 1], [3, 3]])
    poses = np.array([[there, there], [there, here], [there, here], [here, here]])
    assert in_vain(BARRED, np.array(here), motions, poses, True).tolist() == [True, True, False, False]
    assert in_vain(BARRED, np.array(here), motions, poses, False).tolist() == [True, False, False, False]


@pytest.mark.parametrize("make", [planner.synthesise, reachability.synthesise])
def test_a_motion_that_led_nowhere_is_tried_again_where_every_way_needs_one(make):
    """From its pose no motion but waiting has ever led away, so no guess at the map leaves another way."""
    task = flat("F[0,60] West")
    shield = make_shield([make(task)], Config(uncertainty=Uncertainty(), learn_map=True))
    x, y = task.grid.to_map([1.5, 0.5])
    poses = np.array([[x, y, task.grid.origin[2]]] * 2)
    carry = decide(shield, poses[:1], None, True).carry
    turns = [m for m in range(len(task.robot.motions)) if m != task.robot.wait_motion]
    stuck, nothing = tuple((*poses[0].tolist(), m) for m in turns), (None,) * len(task.robot.motions)
    carry = carry._replace(stuck=stuck, witnesses=nothing)
    decision = decide(shield, poses, None, True, carry=carry)
    assert decision.mode == "completion", decision.warnings
    assert decision.warnings == (
        "every way left has a motion that led nowhere from here before: it is tried again",
    )
