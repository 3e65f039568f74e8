"""Margin and slack, worked out by hand on cells of 0.2 m (tests/episode/test_algorithm.py has the map)."""

from collections import Counter

import numpy as np
import pytest

from specshield.episode import Config, decide, make_shield
from specshield.policy.dqn.network import make_network
from specshield.policy.dqn.policy import Policy
from specshield.policy.planner import policy as planner
from specshield.policy.reachability import policy as reachability
from specshield.reasons.still_open import still_open
from specshield.shield.proposal import Proposal
from specshield.shield.uncertainty import Uncertainty
from tests.oracles.cells import FORWARD, LEFT, RIGHT, WAIT, Cells, Scripted, ways
from tests.policy.rooms import random_weights, sizes

EVEN = np.zeros(5)
SHORTEST = {WAIT: [FORWARD], LEFT: [RIGHT, FORWARD], RIGHT: [LEFT, FORWARD]}


def decision(formula, *motions, **config):
    cells = Cells(formula, None, {"A": (1, 0)} if "A" in formula else {})
    history = [cells.pose(0, 0, 0)]
    for motion in motions:
        history.append(cells.pose(*cells.after(cells.state(history[-1]), motion)))
    policy = Scripted(cells, lambda t, motion: SHORTEST.get(motion, []))
    return decide(make_shield([policy], Config(**config)), history, EVEN)


@pytest.mark.parametrize(
    ("formula", "motions", "slack", "feasible", "lowered"),
    [
        ("F[0,4] A", [], 0, [1, 1, 1, 1], False),
        ("F[0,4] A", [], 2, [1, 0, 0, 1], False),  # by step 2: at once, or after one wait
        ("F[0,4] A", [], 9, [1, 0, 0, 1], False),  # a window keeps half its length
        ("F[0,4] A", [WAIT], 2, [1, 0, 0, 0], False),
        ("F[0,4] A", [WAIT, WAIT], 2, [1, 0, 0, 0], True),  # step 3 is the earliest, then
        ("F[0,4] A", [WAIT, WAIT], 0, [1, 0, 0, 1], False),
        ("F[0,4] A and F[2,4] x > 0", [FORWARD], 2, [1, 1, 1, 1], False),  # A is done with
        ("F[2,2] A", [], 5, [1, 0, 0, 0], False),
        ("not G[0,4] not A", [WAIT], 2, [1, 0, 0, 0], False),
        ("x > 0 U[0,4] A", [], 2, [1, 0, 0, 1], False),  # an `until` has a deadline too
        ("x > 0 U[0,4] A", [WAIT], 2, [1, 0, 0, 0], False),
        ("x > 0 U[0,4] A", [WAIT, WAIT], 2, [1, 0, 0, 0], True),
        ("x > 0 U[0,4] A", [WAIT, WAIT], 0, [1, 0, 0, 1], False),
        ("F[0,4] A or F[1,3] x > 9", [WAIT], 1, [1, 0, 0, 1], False),  # and so has an `or`
        ("F[0,4] A or F[1,5] x > 9", [WAIT], 2, [1, 0, 0, 0], False),
        ("G[0,4] F[0,4] A", [], 2, [1, 0, 0, 1], False),  # a patrol
        ("G[0,4] F[0,4] A", [WAIT], 2, [1, 0, 0, 0], False),
        ("G[0,4] F[0,4] A", [WAIT, WAIT], 2, [1, 0, 0, 0], True),
        ("G[0,4] not G[0,4] not A", [], 2, [1, 0, 0, 1], False),  # the same in other words
        ("G[0,4] not A -> x > 9", [WAIT], 2, [1, 0, 0, 0], False),  # what has to end is to end early
        ("G[4,6] A", [WAIT], 2, [1, 0, 0, 0], False),  # what is yet to begin
        ("G[4,6] A", [WAIT], 0, [1, 1, 1, 1], False),
        ("G[4,6] A", [WAIT, WAIT], 2, [1, 0, 0, 0], True),
        ("F[4,4] A", [WAIT], 2, [1, 0, 0, 0], False),
        ("F[4,5] A", [WAIT], 2, [1, 0, 0, 1], False),  # a short window that is far away
        ("F[4,5] A", [WAIT, WAIT], 2, [1, 0, 0, 0], False),
        ("F[4,5] A", [WAIT, WAIT], 0, [1, 1, 1, 1], False),
        ("F[4,5] G[0,1] A", [WAIT, WAIT], 2, [1, 0, 0, 0], False),
        ("F[4,4] G[0,1] A", [WAIT], 2, [1, 0, 0, 0], False),
        ("F[4,5] 1 / (1 + x) < 0.8", [WAIT, WAIT], 2, [1, 1, 1, 1], False),  # it may have no value before
        ("G[1,2] G[3,4] A", [WAIT], 2, [1, 0, 0, 0], False),
        ("G[4,6] abs(2 * x - 1) < 0.6", [WAIT], 2, [1, 0, 0, 0], False),
        ("G[4,6] 1 / (1 + x) < 0.8", [WAIT], 2, [1, 1, 1, 1], False),  # it may have no value before
        ("F[4,5] A or F[4,5] x > 9", [WAIT], 2, [1, 0, 0, 1], False),  # what is far away and not alone
        ("F[4,5] A or F[4,5] x > 9", [WAIT, WAIT], 2, [1, 0, 0, 0], False),
        ("F[4,5] A or F[4,5] x > 9", [WAIT] * 3, 2, [1, 0, 0, 1], True),
        ("F[4,5] (A and G[0,1] x > 0)", [WAIT, WAIT], 2, [1, 0, 0, 0], False),
        ("G[4,6] A or not F[4,6] x < 9", [WAIT], 2, [1, 0, 0, 0], False),
        ("G[0,1] (x < 0.2 -> F[4,4] A)", [WAIT], 2, [1, 0, 0, 0], False),
        ("x > 9 or not F[4,6] not A", [WAIT], 2, [1, 0, 0, 0], False),
        ("F[4,5] 1 / (1 + x) < 0.8 or F[4,5] x > 9", [WAIT, WAIT], 2, [1, 1, 1, 1], False),
        ("G[0,4] (x < 0.2 -> F[0,4] A)", [WAIT], 2, [1, 0, 0, 0], False),  # what is to follow something
        ("F[0,4] (x < 0.2 and F[0,4] A)", [WAIT] * 3, 2, [1, 0, 0, 1], False),  # one after the other
    ],
)
def test_slack_asks_for_deadlines_early_and_for_the_most_that_can_be_had(
    formula, motions, slack, feasible, lowered
):
    found = decision(formula, *motions, slack=slack)
    assert list(found.j_values[:4]) == feasible
    assert (found.reason == "margin_unattainable") == lowered
    assert found.mode == "shaped"
    assert all(rho > 0 for rho, ok in zip(found.robustness, feasible, strict=False) if ok)


def test_slack_is_given_up_where_the_rule_itself_cannot_be_kept():
    lost = decision("F[0,2] A", LEFT, slack=1)
    assert (lost.mode, lost.reason, lost.feasible_mass) == ("fallback", "infeasible", 0.0)


@pytest.mark.parametrize(("slack", "feasible"), [(0, [1, 1, 1, 1]), (2, [1, 0, 0, 0])])
def test_slack_is_kept_beside_as_much_of_the_margin_as_can_be_had(slack, feasible):
    """In row 0 the G is kept by 0.05 m, whatever the robot does, so the deadline is asked for early still."""
    found = decision("F[0,4] A and G[0,4] y < 0.15", WAIT, margin=0.1, slack=slack)
    assert list(found.j_values[:4]) == feasible
    assert (found.reason, found.slack) == ("margin_unattainable", slack)
    assert found.margin == pytest.approx(0.05)


KEPT_FROM_X_0 = ("G[0,3] x > 0.05", "not F[0,3] x <= 0.05", "not not G[0,3] x > 0.05")


@pytest.mark.parametrize("formula", [*KEPT_FROM_X_0, "G[0,3] x > 0.05 or G[0,1] y > 9"])
def test_a_margin_lost_to_what_was_driven_is_asked_of_what_is_to_come(formula):
    """At x_0 the rule is kept by 0.05 m alone; one cell on, by 0.25 m."""
    found = decision(formula, margin=0.1)
    assert (found.mode, found.reason) == ("shaped", None)
    assert list(found.j_values[:4]) == [1, 0, 0, 0]
    assert found.robustness[FORWARD] == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("formula", "motions", "asked", "feasible", "reason"),
    [
        ("F[0,4] A and F[0,0] x > 9", [WAIT], {"slack": 0}, [1, 1, 1, 1], None),
        ("F[0,4] A and F[0,0] x > 9", [WAIT], {"slack": 2}, [1, 0, 0, 0], None),
        ("F[0,4] A and F[0,0] x > 9", [WAIT, WAIT], {"slack": 2}, [1, 0, 0, 0], "margin_unattainable"),
        ("F[0,2] A and F[0,0] x > 9", [LEFT], {"slack": 1}, [0, 0, 0, 0], "infeasible"),
        # the F is settled by 0.05 m; of the G, broken at x_0, one more cell keeps 0.35 m, the others 0.15 m
        ("F[0,0] x > 0.05 and G[0,4] x > 0.15", [FORWARD], {"margin": 0.1}, [1, 1, 1, 1], None),
        ("F[0,0] x > 0.05 and G[0,4] x > 0.15", [FORWARD], {"margin": 0.2}, [1, 0, 0, 0], None),
        ("F[0,0] x > 0.05 and G[0,4] x > 0.15", [FORWARD], {"margin": 0.4}, [1, 0, 0, 0],
         "margin_unattainable"),
    ],
)  # fmt: skip
def test_what_is_left_of_a_violated_rule_has_its_slack_and_its_margin(
    formula, motions, asked, feasible, reason
):
    found = decision(formula, *motions, **asked)
    assert list(found.j_values[:4]) == feasible
    assert (found.mode, found.reason) == ("violated", reason)


@pytest.mark.parametrize("asked", [{"slack": 1}, {"margin": 0.3}, {"slack": 2, "margin": 0.3}])
def test_a_real_valued_j_is_rho_whatever_is_asked_beside_it(asked):
    plain = {"evaluation": "robustness", "threshold": 0.05}
    bare, careful = (decision("F[0,2] A and F[0,3] x > 0.22", **plain, **more) for more in ({}, asked))
    assert careful.j_values == bare.j_values
    assert np.isfinite(careful.j_values[:4]).all()
    assert np.array_equal(careful.distribution, bare.distribution)
    assert careful.distribution[:4] @ careful.j_values[:4] >= 0.05 * careful.distribution[:4].sum() - 1e-12


def test_what_a_nested_rule_still_asks():
    """At t = 8 the windows of G[0,10] F[0,6] that began at step 3 are open still; those before are over."""
    cells = Cells("G[0,10] F[0,6] x > 0.1 and G[0,9] x > -1", None, {})
    history = np.array([cells.pose(0, 0, 0)] * 9)
    task = cells.task
    left = still_open(task, task.formula, history, np.empty((9, 0)))
    assert str(left) == "G[3,10] F[0,6] x > 0.1 and G[9,9] x > -1"


class Everything:
    """Proposes every future there is."""

    id = "everything"

    def __init__(self, cells):
        self.cells, self.task = cells, cells.task

    def propose(self, history, signals, margin):
        rows = ways(self.task.horizon + 1 - len(history))
        return Proposal(rows, WAIT)


def test_a_deadline_that_cannot_come_earlier_leaves_the_others_their_slack():
    """Column 2 is closed until step 5, when the robot has to be there."""
    cells = Cells("F[0,4] A and G[0,4] x < 0.4 and G[5,5] x > 0.4", None, {"A": (1, 0)})
    found = decide(make_shield([Everything(cells)], Config(slack=2)), [cells.pose(0, 0, 0)], EVEN)
    assert (found.slack, found.reason) == (2, "margin_unattainable")
    assert list(found.j_values[:4]) == [1, 0, 0, 1]


@pytest.mark.parametrize(("waits", "slack"), [(0, 2), (1, 2), (2, 1), (3, 0)])
def test_the_slack_that_is_told_is_that_of_the_patrol_that_is_due_next(waits, slack):
    """The robot is where the first patrol leads, and A is due at step 4; it can be there in one step."""
    found = decision("G[0,4] F[0,4] x < 9 and G[0,4] F[0,4] A", *[WAIT] * waits, slack=2)
    assert found.slack == slack


def tables(task):
    return reachability.synthesise(task, reachability.Settings(pitch=0.2))


def plans(task):
    return planner.synthesise(task, planner.Settings(pitch=0.2))


@pytest.mark.parametrize("synthesise", [tables, plans])
@pytest.mark.parametrize(
    ("formula", "states", "feasible", "robustness"),
    [
        # kept by 0.02 m so far, where 0.05 m was asked, and no time to go back: of what is open, the margin
        ("F[0,1] x > 0.48 and F[0,3] y > 0.28", [(2, 0, 1)] * 2, [1, 0, 0, 0], 0.02),
        ("F[0,5] y > 0.68 and F[2,5] y < 0.72", [(2, 3, 0), (2, 3, 1)], [0, 1, 1, 1], 0.02),
        ("F[0,5] G[0,1] x > 0.48 and F[0,4] y > 0.28", [(2, 0, 1)] * 3, [1, 0, 0, 0], 0.02),
        ("G[0,0] x > 0.48 and F[0,4] y > 0.28", [(2, 0, 1)], [1, 1, 1, 1], 0.02),
        # time to go there, and then deeper: of all of it
        ("F[0,6] x > 0.48 and F[0,2] y > 0.28", [(2, 0, 1)], [1, 0, 0, 0], 0.22),
        ("F[1,4] y > 0.28 and F[3,6] y > 0.68", [(2, 3, 2)] * 5, [0, 0, 1, 0], 0.22),
    ],
)  # fmt: skip
def test_a_margin_is_found_beside_what_was_settled_by_less(synthesise, formula, states, feasible, robustness):
    cells = Cells(formula, None, {})
    history, careful = [cells.pose(*state) for state in states], Config(margin=0.05)
    for policy in (Everything(cells), synthesise(cells.task)):
        found = decide(make_shield([policy], careful), history, EVEN)
        assert (found.mode, found.reason) == ("shaped", None)
        assert list(found.j_values[:4]) == feasible
        kept = [rho for rho, ok in zip(found.robustness, feasible, strict=False) if ok]
        assert max(kept) == pytest.approx(robustness)


@pytest.mark.parametrize(
    ("formula", "states", "slack", "feasible"),
    [
        # x > 0.48 is settled by 0.02 m. Deeper in the last step, y two steps later: one of its three is kept
        ("F[0,3] x > 0.48 and F[0,7] y > 0.28", [(2, 0, 0)] * 3, 3, [1, 0, 0, 0]),
        # deeper in three steps, of four; then x < 0.38 in its last step, though any visit leaves it its two
        ("F[0,5] x > 0.48 and F[0,8] x < 0.38", [(2, 0, 2)] * 2, 2, [1, 1, 1, 1]),
        # the first can have 0.03 m at most; deeper for the second, then to the third, in the last three steps
        ("F[0,6] (x > 0.47 and x < 0.53) and F[0,6] y > 0.28 and F[0,6] x > 0.6", [(2, 1, 1)] * 4, 0,
         [1, 0, 0, 0]),
    ],
)  # fmt: skip
def test_a_visit_is_made_again_where_half_the_slack_of_all_else_is_left(formula, states, slack, feasible):
    """Each visit by itself: what one cannot have, or how late it is, does not excuse another one."""
    cells = Cells(formula, None, {})
    history, careful = [cells.pose(*state) for state in states], Config(margin=0.05, slack=slack)
    found = decide(make_shield([Everything(cells)], careful), history, EVEN)
    assert (found.mode, found.margin) == ("shaped", pytest.approx(0.05))
    assert list(found.j_values[:4]) == feasible


def test_a_learned_policy_shares_a_way_that_keeps_the_margin_of_what_is_open():
    """A network that goes ahead always: a turn is undone where ahead settles all that is open."""
    cells = Cells("F[0,9] x > 0.48 and F[0,4] y > 0.28", None, {})
    weights = {name: np.zeros_like(values) for name, values in random_weights(cells.task).items()}
    weights["b3"][FORWARD] = 1.0
    policy = Policy(cells.task, {"id": "ahead"}, make_network(weights, *sizes(cells.task)))
    found = decide(make_shield([policy], Config(margin=0.05)), [cells.pose(2, 0, 1)], EVEN)
    assert (found.mode, found.reason) == ("shaped", None)
    assert list(found.j_values[:4]) == [1, 1, 1, 1]


@pytest.mark.parametrize("slack", [1, 3])
def test_on_its_way_a_robot_may_do_all_that_keeps_the_slack(slack):
    """Every action after which some future of all there are meets the deadline as early as is answered."""

    def early(steps):
        return Cells("F[0,8] A", lambda inside: inside["A"][..., : 9 - steps].any(-1), {"A": (2, 2)})

    worlds = [early(steps) for steps in range(slack + 1)]
    config = Config(slack=slack, uncertainty=Uncertainty(0.0, 0.0, 0.0))
    shield = make_shield([reachability.synthesise(worlds[0].task)], config)
    random, allowed = np.random.default_rng(0), Counter()
    for start in [(0, 0, 0), (0, 0, 1), (0, 2, 2), (2, 0, 3)] * 4:
        history, carry = [worlds[0].pose(*start)], None
        while len(history) < 9 and worlds[0].state(history[-1])[:2] != (2, 2):
            found = decide(shield, history, EVEN, carry=carry)
            if carry is not None:
                expected = worlds[found.slack].feasible(history)
                assert list(found.j_values[:4]) == expected.tolist()
                allowed[expected.sum()] += 1
            motion = int(random.choice(np.flatnonzero(found.j_values[:4])))
            history, carry = [*history, found.next_poses[motion]], found.carry
    assert min(allowed[1], sum(allowed.values()) - allowed[1]) > 5


@pytest.mark.parametrize(
    "formula", ["F[0,6] x < 0.25 -> F[0,3] y > 9", "not F[0,6] x < 0.25", "G[0,6] x > 0.25"]
)
@pytest.mark.parametrize("slack", [0, 3])
def test_the_margin_to_what_must_not_be_reached_stays_to_the_end_of_its_window(formula, slack):
    """Forward leads to 5 cm from it, also in the last steps of the window."""
    cells = Cells(formula, None, {})
    shield = make_shield([Scripted(cells, lambda t, first: [])], Config(margin=0.1, slack=slack))
    for waited in range(6):
        poses = [cells.pose(2, 0, 2)] * (waited + 1)
        found = decide(shield, poses, np.zeros(5))
        assert (found.j_values[FORWARD], found.j_values[WAIT]) == (0.0, 1.0)
