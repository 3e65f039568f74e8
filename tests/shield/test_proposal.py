"""Proposers that lie or fail: nothing is certified without a future that keeps the rule.

The world of tests/episode/test_algorithm.py: a robot in the lower left corner of a few cells, A is the cell
ahead of it.
"""

from __future__ import annotations

import numpy as np
import pytest

from specshield.episode import Config, decide, make_shield, start
from specshield.errors import InfeasibleStart
from specshield.shield.feasibility import prefix_of, simulated
from specshield.shield.proposal import Proposal, adapted, ask
from tests.oracles.cells import END, FORWARD, LEFT, MOTIONS, RIGHT, WAIT, Cells, Exhaustive, Scripted, waits

REACH = Cells("F[0,3] A", lambda s: s["A"][..., :4].any(-1), {"A": (1, 0)})
AVOID = Cells("G[0,3] not A", lambda s: ~s["A"][..., :4].any(-1), {"A": (1, 0)})
EVEN = np.zeros(5)


class Liar:
    """A proposer whose `propose` is what a test says: a function of the history and the margin."""

    id = "liar"

    def __init__(self, answer, cells=REACH):
        self.answer, self.cells, self.task = answer, cells, cells.task

    def propose(self, history, signals, margin):
        return self.answer(history)


def rows(steps, *firsts):
    return np.array([[m] + [WAIT] * (steps - 1) for m in firsts])


class Poses(Proposal):
    """A proposal that also claims poses, which lead to A whatever its motions do."""

    poses = np.full((MOTIONS, 3, 3), [0.3, 0.1, 0.0])


WRONG = {
    "other motions than it claims": lambda h: Poses(rows(4 - len(h), *range(MOTIONS)), FORWARD),
    "rows too short": lambda h: Proposal(rows(3 - len(h), *range(MOTIONS)), FORWARD),
    "rows too long": lambda h: Proposal(rows(9, *range(MOTIONS)), FORWARD),
    "no rows": lambda h: Proposal(np.empty((0, 4 - len(h)), np.int64), FORWARD),
    "one row, not a table": lambda h: Proposal(np.zeros(4 - len(h), np.int64), FORWARD),
    "an index past the last motion": lambda h: Proposal(np.full((MOTIONS, 4 - len(h)), MOTIONS), FORWARD),
    "an index below zero": lambda h: Proposal(np.full((MOTIONS, 4 - len(h)), -1), FORWARD),
    "numbers that are no indices": lambda h: Proposal(np.zeros((MOTIONS, 4 - len(h))), FORWARD),
    "a list": lambda h: Proposal([[FORWARD] * (4 - len(h))], FORWARD),
    "too many rows": lambda h: Proposal(np.zeros((10**6, 4 - len(h)), np.int8), FORWARD),
    "a preference out of range": lambda h: Proposal(rows(4 - len(h), *range(MOTIONS)), 99),
    "a preference that is no number": lambda h: Proposal(rows(4 - len(h), *range(MOTIONS)), None),
    "nothing": lambda h: None,
    "something else": lambda h: {"motions": [[0]]},
    "an exception": lambda h: 1 / 0,
    "only some motions": lambda h: Proposal(rows(4 - len(h), LEFT), LEFT),
}
STANDING = {FORWARD}  # from the corner only `forward`, then standing, reaches A


@pytest.mark.parametrize("name", WRONG)
def test_nothing_is_certified_without_a_future_that_keeps_the_rule(name):
    shield = make_shield([Liar(WRONG[name])])
    history = [REACH.pose(0, 0, 0)]
    decision = decide(shield, history, EVEN, witnesses=True)
    for motion in range(MOTIONS):
        witness = decision.witnesses[motion]
        assert (decision.j_values[motion] == 1.0) == (witness is not None)
        if witness is not None:  # by the cells' own account of where motions lead
            state, visited = (0, 0, 0), []
            for m in (motion, *witness):
                state = REACH.after(state, m)
                visited.append(state[:2])
            assert len(visited) == 3
            assert (1, 0) in visited
    assert {m for m in range(MOTIONS) if decision.j_values[m] == 1.0} <= STANDING
    assert decision.completion_action != END
    if name == "only some motions":
        assert (decision.mode, decision.reason, decision.warnings) == ("fallback", "infeasible", ())
        assert decision.robustness == (None, pytest.approx(-0.1), None, None, None)
    elif name == "other motions than it claims":
        assert decision.warnings == ()
    else:
        (said,) = decision.warnings
        assert "was not used at this step" in said


class Raising(Exhaustive):
    """Proposes every way, and raises where it is told of anything else."""

    def on_body(self, *told):
        raise RuntimeError

    avoiding = foreseeing = earlier = on_body


def test_a_proposer_that_raises_where_it_is_told_of_the_map_is_said_not_to_be_used():
    shield = make_shield([Raising(REACH)])
    decision = decide(shield, [REACH.pose(0, 0, 0)], EVEN, occupied=[[0.5, 0.5]])
    assert decision.warnings == ("a policy was not used at this step: it raised RuntimeError",)
    assert {m for m in range(MOTIONS) if decision.j_values[m] == 1.0} <= STANDING


def test_a_robot_in_a_forbidden_place_is_told_something_though_no_policy_can_be_used():
    """Ways out are continued by what the policies propose at their ends, and here that is nothing."""
    cells = Cells("G[0,6] not C", None, {"C": (0, 0)})
    liar = Liar(lambda history: 1 / 0, cells)
    decision = decide(make_shield([liar]), [cells.pose(0, 0, 0)], EVEN)
    assert decision.mode == "violated"
    assert "a policy was not used at this step: it raised ZeroDivisionError" in decision.warnings


def test_no_future_is_simulated_where_none_is_proposed():
    shield = make_shield([Exhaustive(REACH)])
    history = np.array([REACH.pose(0, 0, 0)])
    prefix = prefix_of(REACH.task, REACH.task.formula, shield.view, history, {})
    found = simulated(prefix, shield.body, [], 0, ["why"])
    assert (len(found.motions), len(found.rho), found.warnings) == (0, 0, ("why",))


def test_a_proposer_without_a_method_for_it_stays_as_it_is():
    honest = Exhaustive(REACH)
    assert adapted(honest, "avoiding", np.zeros(3)) is honest


@pytest.mark.parametrize("how", ["on_body", "avoiding", "foreseeing", "earlier"])
def test_a_proposer_that_cannot_be_told_of_something_raises_when_it_is_asked(how):
    told, history = adapted(Raising(REACH), how, np.zeros(3)), np.array([REACH.pose(0, 0, 0)])
    assert ask(told, history, {}, 0.0, MOTIONS, 3) == (
        None, "a policy was not used at this step: it raised RuntimeError"
    )  # fmt: skip


def test_what_was_wrong_is_said():
    said = {
        "rows too short": "policy 'liar' was not used at this step: its motions have the shape [4, 2]; "
        "expected [N, 3], N from 1 to 333333",
        "an index past the last motion": "policy 'liar' was not used at this step: it names motion 4; the "
        "robot has motions 0 to 3",
        "nothing": "policy 'liar' was not used at this step: it returned NoneType; expected a Proposal",
        "an exception": "a policy was not used at this step: it raised ZeroDivisionError",
    }
    for name, text in said.items():
        assert decide(make_shield([Liar(WRONG[name])]), [REACH.pose(0, 0, 0)], EVEN).warnings == (text,)


@pytest.mark.parametrize("name", [name for name in WRONG if name != "only some motions"])
def test_another_proposer_and_the_witness_certify_beside_a_liar(name):
    honest, alone = Exhaustive(REACH), make_shield([Exhaustive(REACH)])
    both = make_shield([Liar(WRONG[name]), honest])
    history = [REACH.pose(0, 0, 0)]
    first = decide(both, history, EVEN)
    assert first.j_values == decide(alone, history, EVEN).j_values
    # One step on the honest one is gone: the witness's tail still certifies what was executed.
    moved = [*history, first.next_poses[LEFT]]
    kept = decide(make_shield([Liar(WRONG[name])]), moved, None, True, carry=first.carry)
    assert (kept.mode, kept.completion_action) == ("completion", RIGHT)


def test_a_session_does_not_open_on_lies():
    with pytest.raises(InfeasibleStart, match="was found"):
        start(make_shield([Liar(WRONG["only some motions"])]), REACH.pose(0, 0, 0))
    start(make_shield([Liar(WRONG["nothing"])]), REACH.pose(0, 0, 0))  # `forward`, then standing, keeps it


def test_a_violated_rule_is_gone_on_with_beside_a_liar():
    for name, answer in WRONG.items():
        shield = make_shield([Liar(answer, AVOID)])
        history = [AVOID.pose(0, 0, 0), AVOID.pose(1, 0, 0)]  # on A
        decision = decide(shield, history, EVEN)
        assert (decision.mode, decision.spec_status) == ("violated", "violated"), name
        certified = [m for m in range(MOTIONS) if decision.j_values[m] == 1.0]
        assert set(certified) <= {FORWARD}, name  # the one motion that leaves A at once


def test_a_proposer_cannot_change_what_is_judged():
    """Not the history that it is given, nor the motions that it has handed over."""
    held = {}

    class Meddler(Liar):
        def propose(self, history, signals, margin):
            held["motions"] = rows(4 - len(history), *range(MOTIONS))
            history[:] = 0.3  # on A
            return Proposal(held["motions"], WAIT)

    history = np.array([REACH.pose(0, 0, 0)])
    decision = decide(make_shield([Meddler(None)]), history, EVEN)
    held["motions"][:] = FORWARD
    assert decision.j_values == (1.0, 0.0, 0.0, 0.0, 1.0)
    np.testing.assert_array_equal(history[0], REACH.pose(0, 0, 0))
    assert decision.witness is None or set(decision.witness) == {WAIT}


def test_real_valued_j_leaves_out_what_nobody_proposed_a_future_for():
    shield = make_shield([Liar(WRONG["only some motions"])], Config(evaluation="robustness", threshold=-0.2))
    decision = decide(shield, [REACH.pose(0, 0, 0)], EVEN)
    assert decision.j_values == (None, pytest.approx(-0.1), None, None, pytest.approx(-0.1))
    np.testing.assert_allclose(decision.distribution, [0.0, 0.8, 0.0, 0.0, 0.2])


def test_a_future_on_which_the_arithmetic_fails_certifies_nothing():
    singular = Cells("F[2,3] 1 / (x - 0.3) > -1000", None, {"A": (1, 0)})
    shield = make_shield([Scripted(singular, waits)])
    stops = singular.pose(1, 0, 0)
    stops[0] = 0.3
    decision = decide(shield, [singular.pose(0, 0, 0), stops], EVEN)
    assert decision.j_values[WAIT] == 0.0
    assert decision.robustness[WAIT] is None
    assert any("not finite" in said for said in decision.warnings)


def test_a_row_is_given_up_only_where_that_changes_nothing():
    """Several futures for one motion: the best of them is found whatever their order, as by judging all."""
    cells = Cells("G[0,6] not A and F[0,6] C", None, {"A": (1, 0), "C": (0, 1)})
    random = np.random.default_rng(0)
    for _ in range(40):
        every = random.integers(0, MOTIONS, (60, 6))
        shield = make_shield([Liar(lambda h, every=every: Proposal(every, WAIT), cells)])
        decision = decide(shield, [cells.pose(0, 0, 0)], EVEN)
        alone = []
        for row in every:
            one = make_shield([Liar(lambda h, row=row: Proposal(row[None], WAIT), cells)])
            alone.append(decide(one, [cells.pose(0, 0, 0)], EVEN).robustness[row[0]])
        for m in range(MOTIONS):
            of = [rho for rho, row in zip(alone, every, strict=True) if row[0] == m]
            assert decision.robustness[m] == (max(of) if of else None)
