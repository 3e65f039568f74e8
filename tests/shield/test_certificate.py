"""The gate: whatever is claimed of the actions, only what a future of the shield's own shows is certified.

The world of test_proposal.py: a robot in the lower left corner of a few cells, A is the cell ahead of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from specshield.episode import Config, make_shield
from specshield.robot.dynamics import make_body
from specshield.shield.certificate import Claim, as_actions, certify, j_values_of
from specshield.shield.feasibility import prefix_of, simulated, together
from specshield.stl import parse
from tests.oracles.cells import END, FORWARD, LEFT, MOTIONS, RIGHT, WAIT, Cells, Scripted, waits

REACH = Cells("F[0,3] A", lambda s: s["A"][..., :4].any(-1), {"A": (1, 0)})
SHIELD = make_shield([Scripted(REACH, waits)])
PREFIX = prefix_of(REACH.task, REACH.task.formula, SHIELD.view, np.array([REACH.pose(0, 0, 0)]), {})
THEN_STAND = np.array([[motion, WAIT, WAIT] for motion in range(MOTIONS)])
TURN_BACK = np.array([[LEFT, RIGHT, FORWARD]])  # this reaches A at the third step
ALL, NONE = np.ones(MOTIONS, np.bool_), np.zeros(MOTIONS, np.bool_)
FEASIBLE = {FORWARD, LEFT}
ROWS = np.array([FORWARD, MOTIONS, RIGHT, WAIT])  # the future of LEFT is the last row


def tried(prefix=PREFIX, body=SHIELD.body):
    return simulated(prefix, body, [THEN_STAND, TURN_BACK], FORWARD)


def claim(futures=None, motions=ALL, row=ROWS, completion=FORWARD):
    values = np.ones(MOTIONS + 1)
    return Claim(futures or tried(), motions, row, values, values, completion, False)


def certified(claimed, shield=SHIELD, prefix=PREFIX):
    found = certify(shield, shield.body, prefix, claimed)
    assert [way is not None for way in found.witnesses] == found.feasible[:MOTIONS].tolist()
    assert not found.feasible[END]
    return found, set(np.flatnonzero(found.feasible).tolist())


def test_a_claim_that_its_futures_bear_out_is_certified_with_their_motions():
    found, feasible = certified(claim(motions=np.isin(np.arange(MOTIONS), list(FEASIBLE))))
    assert feasible == FEASIBLE
    assert found.warnings == ()
    assert as_actions(SHIELD, found.witnesses, LEFT) == (RIGHT, FORWARD)
    assert as_actions(SHIELD, found.witnesses, FORWARD) == (WAIT, WAIT)
    assert j_values_of(SHIELD, found) == (1.0, 1.0, 0.0, 0.0, 1.0)  # `end` has the highest of the others


def test_motions_that_are_claimed_without_a_future_that_keeps_the_rule_are_not_certified():
    found, feasible = certified(claim())
    assert feasible == FEASIBLE
    assert any("not every action that seemed feasible" in said for said in found.warnings)


@pytest.mark.parametrize(
    "row",
    [
        pytest.param([FORWARD] * MOTIONS, id="the future of another motion"),
        pytest.param([FORWARD, -1, -1, -1], id="no future"),
        pytest.param([FORWARD, 99, -7, 5], id="a future that there is not"),
    ],
)
def test_a_motion_is_certified_by_a_future_of_its_own_alone(row):
    found, feasible = certified(claim(row=np.array(row), completion=WAIT))
    assert feasible == {FORWARD}
    assert found.completion == FORWARD


def test_futures_on_another_map_certify_nothing():
    grid = REACH.task.grid
    elsewhere = make_body(REACH.task.robot, replace(grid, occupied=np.zeros_like(grid.occupied)))
    found, feasible = certified(claim(tried(body=elsewhere)))
    assert feasible == set()
    assert found.warnings
    with pytest.raises(ValueError, match="bodies"):
        together(tried(), tried(body=elsewhere))


@pytest.mark.parametrize("other", ["F[0,3] not A", "G[0,3] (A or not A)"])
def test_futures_that_were_judged_by_another_formula_are_judged_again(other):
    _, feasible = certified(claim(tried(PREFIX.of(parse(other)))))
    assert feasible == FEASIBLE


def test_a_completion_that_is_not_certified_gives_way_to_one_that_is():
    for completion in (WAIT, END):
        assert certified(claim(completion=completion))[0].completion in FEASIBLE
    last = claim(tried(PREFIX.of(parse("F[0,3] not A"))), completion=END)  # here the last motion is certified
    prefix = last.tried.prefix
    assert certify(SHIELD, SHIELD.body, prefix, last).completion != END
    assert certified(claim(motions=NONE, completion=WAIT))[0].completion == WAIT  # nothing is: it is the best


def test_a_real_value_is_at_most_the_robustness_of_some_future():
    shield = replace(SHIELD, config=Config(evaluation="robustness", threshold=0.0))
    found, _ = certified(claim(), shield)
    futures = tried()
    best = [max(futures.rho[futures.motions[:, 0] == motion]) for motion in range(MOTIONS)]
    assert found.values[:MOTIONS].tolist() == best
