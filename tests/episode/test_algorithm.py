"""Every mode and reason of a decision, worked out by hand on a few cells.

The robot starts in the lower left corner looking east; A is the cell ahead of it, B the next, C above.

    . . . . .        F[0,3] A: forward at once, or after waiting or turning and turning back
    . # . # .
    . . . . .
    C # . . .
    > A B . #
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from specshield.episode import Config, close, decide, make_shield, start
from specshield.errors import InputError, LogitsError, PolicyError, PoseError, SampleError
from specshield.shield.shaping import log_softmax
from specshield.stl import robustness
from tests.oracles.cells import END, FORWARD, LEFT, MOTIONS, RIGHT, WAIT, Cells, Exhaustive, Scripted, waits

AT = {"A": (1, 0), "B": (2, 0), "C": (0, 1)}
EVEN = np.zeros(5)


def cells_of(formula, keeps=None):
    named = {name: cell for name, cell in AT.items() if name in formula}
    return Cells(formula, keeps, named)


REACH = cells_of("F[0,3] A", lambda s: s["A"][..., :4].any(-1))
START = REACH.pose(0, 0, 0)


def shield_of(cells=REACH, policy=None, **config):
    return make_shield([policy or Exhaustive(cells)], Config(**config))


def walk(cells, *motions, start=START):
    history = [np.array(start)]
    for motion in motions:
        history.append(cells.pose(*cells.after(cells.state(history[-1]), motion)))
    return history


def one_hot(action):
    return np.eye(5)[action].tolist()


# Shaped


def test_the_prior_on_the_feasible_actions_renormalised():
    logits = np.log([0.4, 0.1, 0.1, 0.2, 0.2])
    decision = decide(shield_of(), walk(REACH, WAIT), logits)  # two steps left: turning away is one too many
    assert decision.mode == "shaped"
    assert decision.j_values == (1.0, 0.0, 0.0, 1.0, 1.0)
    # Of the mass that does not end, 0.8, two thirds stay with `forward`.
    np.testing.assert_allclose(decision.distribution, [0.8 * 2 / 3, 0.0, 0.0, 0.8 / 3, 0.2], atol=1e-12)
    assert decision.distribution[LEFT] == 0.0
    assert decision.feasible_mass == pytest.approx(0.6 / 0.8)
    assert decision.kl == pytest.approx(0.8 * math.log(0.8 / 0.6))
    assert (decision.reason, decision.spec_status, decision.finished) == (None, "pending", False)
    assert decision.completion_action in (FORWARD, WAIT)
    assert decision.t == 1
    assert decision.action_name == ("forward", "left", "right", "wait", "end")[decision.action]
    np.testing.assert_allclose(
        decision.next_poses, [*(walk(REACH, WAIT, m)[-1] for m in range(4)), START], atol=1e-9
    )
    assert decision.robustness[END] is None
    assert decision.robustness[FORWARD] == pytest.approx(0.1)  # a cell's centre is 0.1 m inside it
    assert decision.robustness[LEFT] == pytest.approx(-0.1)


def test_the_model_is_left_alone_where_everything_is_feasible():
    logits = np.array([0.3, -1.0, 0.2, 2.0, -0.5])
    decision = decide(shield_of(), [START], logits)
    np.testing.assert_allclose(decision.distribution, np.exp(log_softmax(logits)), atol=1e-12)
    assert (decision.mode, decision.feasible_mass) == ("shaped", 1.0)
    assert decision.kl == pytest.approx(0.0, abs=1e-12)


def test_the_joint_trajectory_is_judged_not_each_conjunct_alone():
    """A and C can each be had in four steps, both cannot."""
    for cells in (
        cells_of("F[0,4] A", lambda s: s["A"][..., :5].any(-1)),
        cells_of("F[0,4] C", lambda s: s["C"][..., :5].any(-1)),
    ):
        assert decide(shield_of(cells), [START], EVEN).feasible_mass > 0
    both = cells_of("F[0,4] A and F[0,4] C", lambda s: s["A"][..., :5].any(-1) & s["C"][..., :5].any(-1))
    decision = decide(shield_of(both), [START], EVEN)
    assert (decision.mode, decision.reason, decision.feasible_mass) == ("fallback", "infeasible", 0.0)


# The terminal token


@pytest.mark.parametrize("ending", [1e-9, 0.3, 0.999])
def test_end_keeps_exactly_its_prior_mass_in_shaped_and_fallback(ending):
    logits = np.log(np.array([0.1, 0.2, 0.3, 0.4, 0.0]) * (1 - ending) + one_hot(END) * np.array(ending))
    shaped = decide(shield_of(), walk(REACH, WAIT, WAIT), logits)
    assert (shaped.mode, shaped.j_values) == ("shaped", (1.0, 0.0, 0.0, 0.0, 1.0))
    np.testing.assert_allclose(shaped.distribution, [1 - ending, 0, 0, 0, ending], atol=1e-12)
    lost = decide(shield_of(), walk(REACH, WAIT, LEFT), logits)
    assert (lost.mode, lost.reason, lost.j_values) == ("fallback", "infeasible", (0.0,) * 5)
    assert lost.distribution[END] == pytest.approx(ending, rel=1e-9)
    assert lost.distribution[lost.completion_action] == pytest.approx(1 - ending)


def test_all_mass_on_end_returns_the_prior():
    decision = decide(shield_of(), walk(REACH, WAIT), [-math.inf] * 4 + [3.0])
    assert decision.distribution.tolist() == one_hot(END)
    assert (decision.mode, decision.kl, decision.feasible_mass) == ("shaped", 0.0, None)
    assert decision.action == END
    # It moves nothing: the robot executes the completion action, and the witness follows that one.
    assert decision.completion_action != END
    assert decision.witness is not None
    np.testing.assert_array_equal(decision.next_poses[END], START)
    assert decide(shield_of(), walk(REACH, WAIT, LEFT), [-math.inf] * 4 + [3.0]).reason == "infeasible"


# Completion, prior, the horizon


@pytest.mark.parametrize("logits", [None, EVEN])
def test_main_task_over_the_certified_continuation_to_the_end(logits):
    history, carry = [START], None
    for t in range(3):
        decision = decide(shield_of(), history, logits, True, carry=carry)
        if decision.spec_status == "satisfied":
            break
        assert (decision.mode, decision.reason, decision.finished) == ("completion", None, False)
        assert decision.distribution.tolist() == one_hot(decision.completion_action)
        assert decision.completion_action == decision.action != END
        assert len(decision.witness) == 2 - t
        if logits is None:
            assert decision.kl is decision.feasible_mass is None
        else:
            assert decision.kl == pytest.approx(math.log(5))
        history, carry = [*history, decision.next_poses[decision.action]], decision.carry
    final = decide(shield_of(), history, logits, True, carry=carry)
    assert (final.spec_status, final.mode, final.finished) == ("satisfied", "prior", True)
    assert final.completion_action is None


def test_completion_without_a_future_is_the_policy_and_says_so():
    decision = decide(shield_of(policy=Scripted(REACH, waits, RIGHT)), walk(REACH, WAIT, LEFT), None, True)
    assert (decision.mode, decision.reason) == ("fallback", "infeasible")
    assert decision.distribution.tolist() == one_hot(RIGHT)
    assert decision.witness is None


def test_a_satisfied_prefix_returns_the_prior():
    logits = np.array([1.0, 0.0, -math.inf, 0.0, 2.0])
    decision = decide(shield_of(), walk(REACH, FORWARD), logits)
    np.testing.assert_allclose(decision.distribution, np.exp(log_softmax(logits)))
    assert (decision.mode, decision.spec_status) == ("prior", "satisfied")
    assert decision.kl == pytest.approx(0.0, abs=1e-12)
    assert decision.j_values == decision.robustness == (None,) * 5
    assert decision.feasible_mass is decision.completion_action is decision.reason is decision.witness is None
    assert not decision.finished
    assert decide(shield_of(), walk(REACH, FORWARD), None, True).finished


@pytest.mark.parametrize(
    ("motions", "status"), [((FORWARD, WAIT, WAIT), "satisfied"), ((WAIT,) * 3, "violated")]
)
@pytest.mark.parametrize("further", [0, 2])
def test_from_the_horizon_on_the_prior(motions, status, further):
    history = walk(REACH, *motions, *[WAIT] * further)
    decision = decide(shield_of(), history, EVEN)
    assert (decision.mode, decision.spec_status, decision.completion_action) == ("prior", status, None)
    np.testing.assert_allclose(decision.distribution, 0.2)
    assert not decision.finished
    assert decide(shield_of(), history, None, True).finished
    assert close(shield_of(), history)[0] == status


def test_g_is_not_satisfied_before_its_end_and_the_last_state_counts():
    cells = cells_of("G[0,3] not A", lambda s: ~s["A"][..., :4].any(-1))
    decision = decide(shield_of(cells), walk(cells, WAIT, WAIT), EVEN)
    assert (decision.spec_status, decision.j_values[:4]) == ("pending", (0.0, 1.0, 1.0, 1.0))
    assert close(shield_of(cells), walk(cells, WAIT, WAIT))[0] == "pending"
    assert close(shield_of(cells), walk(cells, WAIT, WAIT, FORWARD)) == (
        "violated",
        pytest.approx((-0.1, -0.1)),
    )


def test_rho_of_zero_is_not_satisfied():
    cells = Cells("F[0,2] x > 0.3", lambda s: np.zeros(s["A"].shape[:-1], bool), {"A": (0, 0)})
    decision = decide(shield_of(cells, Scripted(cells, waits)), [np.array([0.1, 0.1, 0.0])], EVEN)
    assert decision.robustness[FORWARD] == pytest.approx(0.0, abs=1e-15)
    exact = Cells(f"F[0,2] x > {float(decision.next_poses[FORWARD][0])!r}", None, {"A": (0, 0)})
    decision = decide(shield_of(exact, Scripted(exact, waits)), [np.array([0.1, 0.1, 0.0])], EVEN)
    assert decision.robustness[FORWARD] == 0.0
    assert decision.j_values[FORWARD] == 0.0


def test_the_session_ends_at_max_steps():
    assert shield_of().max_steps == 600
    history = walk(REACH, FORWARD, WAIT, WAIT, WAIT)
    assert decide(shield_of(max_steps=4), history, EVEN).finished
    assert not decide(shield_of(max_steps=5), history, EVEN).finished


# Fallback


def test_zero_prior_mass_falls_back_to_the_certified_continuation():
    logits = np.array([-math.inf, 0.0, 0.0, -math.inf, 0.0])
    decision = decide(
        shield_of(policy=Scripted(REACH, lambda t, m: [FORWARD], LEFT)), walk(REACH, WAIT), logits
    )
    assert (decision.mode, decision.reason) == ("fallback", "zero_prior_mass")
    # `left` is what the policy itself would do, but it is not certified; `forward` and `wait` are.
    assert decision.completion_action in (FORWARD, WAIT)
    assert decision.distribution[decision.completion_action] == pytest.approx(2 / 3)
    assert (decision.kl, decision.feasible_mass) == (None, 0.0)


def test_infeasible_falls_back_to_the_policy():
    decision = decide(shield_of(policy=Scripted(REACH, waits, LEFT)), walk(REACH, WAIT, RIGHT), EVEN)
    assert (decision.mode, decision.reason) == ("fallback", "infeasible")
    np.testing.assert_allclose(decision.distribution, [0, 0.8, 0, 0, 0.2])
    assert decision.carry.witnesses == (None,) * 4


# Violated


def test_a_broken_f_is_dropped_and_the_rest_is_kept():
    cells = cells_of(
        "F[0,1] A and F[2,4] B and G[0,4] not C",
        lambda s: s["B"][..., 2:5].any(-1) & ~s["C"][..., :5].any(-1),  # what is left
    )
    history, carry, shield = walk(cells, WAIT, WAIT), None, shield_of(cells)
    while len(history) < 5:
        decision = decide(shield, history, EVEN, carry=carry)
        assert (decision.mode, decision.spec_status, decision.reason) == ("violated", "violated", None)
        assert decision.j_values == (1.0, 0.0, 0.0, 0.0, 1.0)
        np.testing.assert_allclose(decision.distribution, [0.8, 0, 0, 0, 0.2])
        assert max(decision.robustness[:4]) < 0.0  # of the whole formula
        history, carry = [*history, decision.next_poses[FORWARD]], decision.carry
    assert decide(shield, history, EVEN).spec_status == "violated"
    assert robustness(cells.task.formula.children[1], cells.task.samples(np.array(history))) > 0


def test_a_broken_g_is_enforced_again_from_the_next_step():
    cells = cells_of("G[0,4] not A and F[0,4] B", lambda s: s["B"].any(-1))
    on_a = walk(cells, FORWARD)
    decision = decide(shield_of(cells), on_a, EVEN)
    assert (decision.mode, decision.spec_status) == ("violated", "violated")
    assert decision.j_values == (1.0, 0.0, 0.0, 0.0, 1.0)  # off A at once, and to B
    turned = walk(cells, FORWARD, LEFT)
    trapped = decide(
        shield_of(cells), turned, EVEN
    )  # looking away, it cannot leave A in one step: B alone is kept
    assert trapped.mode == "violated"
    assert trapped.j_values[RIGHT] == 1.0
    assert trapped.j_values[WAIT] == 0.0


def test_of_a_broken_g_over_an_f_the_visit_that_is_open_yet_is_kept():
    """Due once in steps 0 to 2, 1 to 3 and 2 to 4: the last can be kept yet, though the G ends at step 2."""
    cells = cells_of("G[0,2] F[0,2] A", lambda s: s["A"][..., 2:5].any(-1))
    decision = decide(shield_of(cells), walk(cells, WAIT, WAIT, WAIT), EVEN)
    assert (decision.mode, decision.reason) == ("violated", None)
    assert decision.j_values == (1.0, 0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize("lost", ["", " and G[0,1] (C U[0,8] A)"])
def test_a_visit_that_came_too_late_once_is_not_put_off_at_each_step(lost):
    """It was asked for anew at each step, within two steps from the next one, so whoever waited could go on
    waiting; and not at all beside a broken part of which nothing can be kept.
    """
    cells = cells_of(f"G[0,7] F[0,2] A{lost}")
    go = {FORWARD: [], WAIT: [FORWARD], LEFT: [RIGHT, FORWARD], RIGHT: [LEFT, FORWARD]}
    shield = shield_of(cells, Scripted(cells, lambda t, motion: go[motion]))
    assert decide(shield, walk(cells, WAIT, WAIT, WAIT), EVEN).j_values == (1.0, 0.0, 0.0, 0.0, 1.0)


def test_after_the_last_visit_that_is_open_it_is_said_that_what_was_left_is_kept():
    """It was said until the horizon that it would be kept again, as if a visit were still due."""
    cells = cells_of("G[0,2] F[0,2] A", lambda s: s["A"][..., 2:5].any(-1))
    shield = shield_of(cells, learn_map=True)
    before = decide(shield, walk(cells, WAIT, WAIT), EVEN).warnings
    after = decide(shield, walk(cells, WAIT, WAIT, FORWARD), EVEN).warnings
    assert before == ("G[0,2] F[0,2] A was broken, and is kept again as soon as it can be",)
    assert after == ("G[0,2] F[0,2] A was broken, and what was left of it is kept",)
    lost = cells_of("G[0,2] (F[0,2] A and G[0,1] B)", lambda s: s["A"][..., 2:5].any(-1))
    decision = decide(shield_of(lost, learn_map=True), walk(lost, WAIT, WAIT, WAIT), EVEN)
    assert decision.warnings[0] == f"{lost.task.formula} was not kept, and is given up"


def test_what_is_missed_is_told_of_the_ways_that_were_tried():
    """An explanation looks at more of them: beside its own figure, "no way was found" was not so."""
    ahead = REACH.pose(1, 0, 0)[0]
    for place, by in ((f"x > {ahead}", "0"), (f"x > {ahead + 1.0}", "1")):
        cells = cells_of(f"F[0,2] A and F[0,2] {place}", lambda s: np.zeros(s["A"].shape[:-1], bool))
        decision = decide(shield_of(cells, Scripted(cells, waits), learn_map=True), walk(cells), EVEN)
        told = f"no way that was tried keeps F[0,2] {place}: the best misses it by {by}"
        assert decision.warnings == (told,)


def test_where_nothing_can_be_kept_the_policy_takes_over():
    cells = cells_of("F[0,1] A and F[0,3] x > 99", lambda s: np.zeros(s["A"].shape[:-1], bool))
    decision = decide(shield_of(cells, Scripted(cells, waits, LEFT)), walk(cells, WAIT, WAIT), EVEN)
    assert (decision.mode, decision.reason) == ("violated", "infeasible")
    np.testing.assert_allclose(decision.distribution, [0, 0.8, 0, 0, 0.2])
    alone = cells_of("F[0,1] A and F[0,3] A")
    history = walk(alone, WAIT, WAIT, WAIT)
    assert decide(shield_of(alone, Scripted(alone, waits)), history, EVEN).mode == "prior"  # t = T


def test_violated_with_real_valued_j_keeps_what_is_left():
    cells = cells_of("F[0,1] A and F[2,4] B", lambda s: s["B"][..., 2:5].any(-1))
    shield = shield_of(cells, evaluation="robustness", threshold=0.1 - 1e-9)
    decision = decide(shield, walk(cells, WAIT, WAIT), EVEN)
    assert (decision.mode, decision.reason) == ("violated", None)
    assert decision.j_values[FORWARD] == pytest.approx(0.1)
    assert decision.robustness[FORWARD] == pytest.approx(-0.1)
    assert decision.distribution[FORWARD] == pytest.approx(0.8, abs=1e-6)


def test_violated_and_over_is_finished():
    cells = cells_of("F[0,1] A and F[2,4] B", lambda s: s["B"][..., 2:5].any(-1))
    decision = decide(shield_of(cells), walk(cells, WAIT, WAIT), None, True)
    assert (decision.mode, decision.finished) == ("violated", True)
    assert decision.distribution.tolist() == one_hot(FORWARD)


# Thresholds, robustness, margins


@pytest.mark.parametrize("threshold", [0.25, 0.9])
def test_a_threshold_below_one_moves_only_what_it_must(threshold):
    logits = np.log([0.1, 0.3, 0.2, 0.3, 0.1])
    decision = decide(shield_of(threshold=threshold), walk(REACH, WAIT), logits)  # S_t: forward, wait; 4/9
    conditional = decision.distribution[:4] / 0.9
    assert decision.distribution[END] == pytest.approx(0.1)
    if threshold < 4 / 9:
        np.testing.assert_allclose(conditional, np.array([1, 3, 2, 3]) / 9)
    else:
        np.testing.assert_allclose(conditional, [0.9 / 4, 0.1 * 3 / 5, 0.1 * 2 / 5, 0.9 * 3 / 4])
    assert decision.mode == "shaped"


def test_real_valued_j_is_tilted_to_its_threshold():
    cells = Cells("F[0,1] x > 0.2", None, {"A": (0, 0)})  # rho is 0.1 after `forward`, else -0.1

    def shield(threshold):
        return shield_of(cells, Scripted(cells, waits), evaluation="robustness", threshold=threshold)

    for threshold in (-0.05, 0.0, 0.08):
        decision = decide(shield(threshold), [START], EVEN)
        assert (decision.mode, decision.reason) == ("shaped", None)
        np.testing.assert_allclose(decision.j_values, [0.1, -0.1, -0.1, -0.1, 0.1], atol=1e-12)
        assert decision.distribution[END] == pytest.approx(0.2)
        conditional = decision.distribution[:4] / 0.8
        assert conditional @ decision.j_values[:4] == pytest.approx(threshold, abs=1e-9)
        assert len(set(np.round(conditional[1:], 12))) == 1
    highest = decide(shield(0.0), [START], EVEN).j_values[FORWARD]
    np.testing.assert_allclose(decide(shield(highest), [START], EVEN).distribution, [0.8, 0, 0, 0, 0.2])
    above = decide(shield(highest + 1e-9), [START], EVEN)
    assert (above.mode, above.reason, above.completion_action) == ("fallback", "infeasible", FORWARD)
    without = decide(shield(0.05), [START], [-math.inf, 0, 0, 0, 0])
    assert (without.mode, without.reason) == ("fallback", "zero_prior_mass")
    low = decide(shield(-9.0), [START], EVEN)
    np.testing.assert_allclose(low.distribution, 0.2)


def test_a_margin_asks_for_more_robustness():
    # A policy that after `wait` goes to the cell's middle (rho 0.1); after `left` it never gets there.
    script = {WAIT: [FORWARD], LEFT: [RIGHT, FORWARD]}
    policy = Scripted(REACH, lambda t, motion: script.get(motion, []))
    attainable = decide(shield_of(policy=policy, margin=0.05), [START], EVEN)
    assert (attainable.mode, attainable.reason) == ("shaped", None)
    assert attainable.j_values == (1.0, 1.0, 0.0, 1.0, 1.0)
    best = decide(shield_of(policy=policy, margin=0.5), [START], EVEN)
    assert (best.mode, best.reason) == ("shaped", "margin_unattainable")
    assert best.j_values[RIGHT] == 0.0
    assert best.j_values[FORWARD] == 1.0 or best.j_values[WAIT] == 1.0
    done = decide(shield_of(policy=policy, margin=0.5), [START], None, True)
    assert (done.mode, done.reason) == ("completion", "margin_unattainable")
    start(shield_of(policy=policy, margin=0.5), START)
    lost = decide(shield_of(policy=policy, margin=0.5), walk(REACH, WAIT, LEFT), EVEN)
    assert (lost.mode, lost.reason) == ("fallback", "infeasible")


def test_the_largest_attainable_margin_is_looked_for_without_it():
    """A policy that gives up where the margin cannot be had is asked again without one."""
    asked = []

    class GivesUp(Scripted):
        def propose(self, history, signals, margin):
            asked.append(margin)
            script = waits if margin > 0.0 else (lambda t, m: [FORWARD])
            return Scripted(REACH, script).propose(history, signals, margin)

    decision = decide(shield_of(policy=GivesUp(REACH, waits), margin=0.5), [START], EVEN)
    assert asked == [0.5, 0.0]
    assert decision.reason == "margin_unattainable"
    assert decision.feasible_mass > 0


def test_a_margin_is_pursued_after_zero_is_passed():
    cells = Cells("F[0,4] x > 0.2", None, {"A": (0, 0)})
    policy = Scripted(cells, lambda t, m: [FORWARD] * 3, FORWARD)
    history = walk(cells, FORWARD)
    assert decide(shield_of(cells, policy), history, EVEN).mode == "prior"
    decision = decide(shield_of(cells, policy, margin=0.25), history, EVEN)  # x > 0.45: the next cell
    assert (decision.mode, decision.spec_status, decision.completion_action) == (
        "shaped",
        "satisfied",
        FORWARD,
    )
    assert decide(shield_of(cells, policy, margin=0.25), walk(cells, FORWARD, FORWARD), EVEN).mode == "prior"


# Witnesses, residuals, carry


def test_the_tail_of_the_witness_certifies_where_the_policy_does_not():
    first = decide(shield_of(policy=Scripted(REACH, lambda t, m: [FORWARD])), [START], EVEN)
    assert first.j_values[:4] == (1.0, 0.0, 0.0, 1.0)
    nonsense = shield_of(policy=Scripted(REACH, lambda t, m: [LEFT] * 9, LEFT))
    history = [START, first.next_poses[WAIT]]
    carry = first.carry
    kept = decide(nonsense, history, EVEN, carry=carry)
    # `forward` certifies itself: A is reached by it. The tail of wait's witness is the same.
    assert (kept.mode, kept.completion_action) == ("shaped", FORWARD)
    assert decide(nonsense, history, EVEN).completion_action == FORWARD
    late = [*history, history[-1]]
    assert decide(nonsense, late, EVEN, carry=carry).residual is None  # of another step
    assert kept.residual == (0.0, 0.0)


@pytest.mark.parametrize("alone", [1, 2])
def test_the_witness_certifies_also_after_steps_in_which_it_was_followed_without_a_decision(alone):
    """As a robot does that has lost the service for a while. No policy finds a way for it afterwards."""
    cells, way = cells_of("F[0,6] B", lambda s: s["B"].any(-1)), [LEFT, RIGHT, FORWARD, FORWARD]
    first = decide(shield_of(cells, Scripted(cells, lambda t, m: way)), [START], EVEN)
    lost = shield_of(cells, Scripted(cells, waits))
    decision = decide(lost, walk(cells, WAIT, *way[:alone]), None, True, carry=first.carry)
    assert (decision.mode, decision.action, decision.residual) == ("completion", way[alone], None)
    assert decide(lost, walk(cells, WAIT, *way[:alone]), None, True).mode == "fallback"


def test_of_two_witnesses_from_one_pose_the_one_counts_that_was_followed_without_a_decision():
    """In front of a wall `forward` leads where `wait` does; each goes on by a way of its own."""
    cells, south = cells_of("F[0,7] B", lambda s: s["B"].any(-1)), REACH.pose(0, 0, 3)
    ways = {FORWARD: [LEFT, FORWARD, FORWARD], WAIT: [RIGHT, RIGHT, RIGHT, FORWARD, FORWARD]}
    first = decide(shield_of(cells, Scripted(cells, lambda t, m: ways.get(m, []))), [south], EVEN)
    assert first.j_values[:4] == (1.0, 0.0, 0.0, 1.0)
    for motion, way in ways.items():
        history = walk(cells, motion, way[0], start=south)
        decision = decide(shield_of(cells, Scripted(cells, waits)), history, None, True, carry=first.carry)
        assert (decision.mode, decision.action) == ("completion", way[1])


def test_the_witness_is_used_before_anything_better():
    """In completion the robot goes on as certified, though the policy now prefers something else."""
    first = decide(
        shield_of(policy=Scripted(REACH, lambda t, m: [LEFT, RIGHT, FORWARD])), [START], None, True
    )
    cells = cells_of("F[0,6] A", lambda s: s["A"].any(-1))
    first = decide(
        shield_of(cells, Scripted(cells, lambda t, m: [LEFT, RIGHT, FORWARD, FORWARD])), [START], EVEN
    )
    history = [START, first.next_poses[WAIT]]
    for policy in (Scripted(cells, lambda t, m: [FORWARD], WAIT), Scripted(cells, waits, WAIT)):
        decision = decide(shield_of(cells, policy), history, None, True, carry=first.carry)
        assert (decision.mode, decision.action) == ("completion", LEFT)
    assert (
        decide(shield_of(cells, Scripted(cells, lambda t, m: [FORWARD], WAIT)), history, None, True).action
        == WAIT
    )


def test_the_residual_is_to_the_nearest_pose_foreseen():
    first = decide(shield_of(), [START], EVEN)
    for offset, turn in ((0.03, 0.0), (0.0, -0.1), (0.03, 0.1)):
        pose = first.next_poses[LEFT] + [offset, 0.0, turn]
        moved, turned = decide(
            shield_of(policy=Scripted(REACH, waits)), [START, pose], EVEN, carry=first.carry
        ).residual
        assert (moved, turned) == pytest.approx((offset, abs(turn)))
    # A heading of -179 degrees is 2 degrees from 179.
    west = walk(REACH, start=REACH.pose(0, 0, 2))
    first = decide(shield_of(policy=Scripted(REACH, waits)), west, EVEN)
    pose = first.next_poses[WAIT] + [0.0, 0.0, 0.02]
    found = decide(shield_of(policy=Scripted(REACH, waits)), [*west, pose], EVEN, carry=first.carry)
    assert found.residual == pytest.approx((0.0, 0.02))
    assert first.residual is None


def test_under_mismatch_the_tail_is_simulated_from_where_the_robot_is():
    cells = cells_of("F[0,6] A", lambda s: s["A"].any(-1))
    first = decide(shield_of(cells, Scripted(cells, lambda t, m: [FORWARD])), [START], EVEN)
    slipped = first.next_poses[WAIT] + [0.02, 0.01, 0.0]
    decision = decide(
        shield_of(cells, Scripted(cells, waits)), [START, slipped], None, True, carry=first.carry
    )
    assert (decision.mode, decision.action) == ("completion", FORWARD)
    np.testing.assert_allclose(decision.next_poses[FORWARD], slipped + np.array([0.2, 0.0, 0.0]), atol=1e-9)
    turned = first.next_poses[WAIT] + [0.0, 0.0, 0.4]  # too far off: the tail no longer reaches A
    lost = decide(shield_of(cells, Scripted(cells, waits)), [START, turned], None, True, carry=first.carry)
    assert (lost.mode, lost.residual) == ("fallback", (0.0, pytest.approx(0.4)))


@pytest.mark.parametrize("turns", [-3, 1, 1000])
def test_headings_may_come_in_any_turn(turns):
    history = walk(REACH, WAIT)
    shifted = [pose + np.array([0.0, 0.0, 2 * math.pi * turns]) for pose in history]
    one, two = (decide(shield_of(policy=Scripted(REACH, waits)), h, EVEN) for h in (history, shifted))
    np.testing.assert_allclose(one.next_poses, two.next_poses, atol=1e-9)
    assert one.j_values == two.j_values
    start(shield_of(), shifted[0])


# Signals


def test_a_signals_last_value_is_held_and_its_first_is_declared():
    cells = Cells("F[0,4] battery > 0.5 and F[0,4] A", REACH.keeps, {"A": AT["A"]}, {"battery": 0.2})
    shield = shield_of(cells)
    history = walk(cells, WAIT)
    assert decide(shield, history, EVEN).reason == "infeasible"  # 0.2 is held
    assert decide(shield, history, EVEN, signals={"battery": np.array([0.2, 0.3])}).reason == "infeasible"
    assert decide(shield, history, EVEN, signals={"battery": np.array([0.2, 0.9])}).mode == "shaped"
    assert decide(shield, history, EVEN, signals={"battery": np.array([0.9, 0.2])}).mode == "shaped"
    assert close(shield, walk(cells, FORWARD), {"battery": np.array([0.9, 0.1])})[0] == "satisfied"
    with pytest.raises(SampleError):
        decide(shield, history, EVEN, signals={"battery": np.array([0.2, math.nan])})


# The draw


def test_the_draw_is_repeatable_and_fair():
    logits = np.log([0.5, 0.2, 0.1, 0.15, 0.05])
    history = walk(REACH, FORWARD)
    draws = [
        decide(shield_of(policy=Scripted(REACH, waits), seed=seed), history, logits).action
        for seed in range(2000)
    ]
    counts = np.bincount(draws, minlength=5)
    expected = 2000 * np.exp(logits)
    assert (np.abs(counts - expected) < 4.5 * np.sqrt(expected)).all()
    again = [
        decide(shield_of(policy=Scripted(REACH, waits), seed=seed), history, logits).action
        for seed in range(50)
    ]
    assert again == draws[:50]
    by_time = [
        decide(shield_of(policy=Scripted(REACH, waits)), history + [history[-1]] * k, EVEN).action
        for k in range(60)
    ]
    assert len(set(by_time)) == 5


def test_what_has_no_mass_is_never_drawn():
    logits = np.array([-math.inf, 0.0, -math.inf, 0.0, -math.inf])
    shield = [shield_of(policy=Scripted(REACH, waits), seed=seed) for seed in range(200)]
    assert {decide(s, walk(REACH, FORWARD), logits).action for s in shield} == {LEFT, WAIT}


# Bad input


@pytest.mark.parametrize(
    ("logits", "path"),
    [
        (None, "logits"),
        (np.zeros(4), "logits"),
        (np.zeros((5, 1)), "logits"),
        ([0.0, math.nan, 0.0, 0.0, 0.0], "logits[1]"),
        ([0.0, 0.0, 0.0, math.inf, 0.0], "logits[3]"),
        ([-math.inf] * 5, "logits"),
    ],
)
@pytest.mark.parametrize("motions", [(), (FORWARD,), (WAIT, WAIT)])
def test_bad_logits_name_the_field_in_every_mode(logits, path, motions):
    with pytest.raises(LogitsError) as caught:
        decide(shield_of(), walk(REACH, *motions), logits)
    assert caught.value.path == path


@pytest.mark.parametrize(
    "pose",
    [
        (math.nan, 0.1, 0.0),
        (0.1, math.inf, 0.0),
        (0.1, 0.1),
        (-0.01, 0.1, 0.0),
        (0.1, 1.01, 0.0),
        (0.3, 0.3, 0.0),
    ],
)
def test_bad_starts(pose):
    with pytest.raises(PoseError) as caught:
        start(shield_of(), pose)
    assert caught.value.path == "initial_pose"


@pytest.mark.parametrize(
    "history", [[], [[0.1, 0.1]], [[0.1, 0.1, 0.0], [0.1, math.nan, 0.0]], [[1e308, 0.1, math.inf]]]
)
def test_bad_histories(history):
    with pytest.raises(PoseError) as caught:
        decide(shield_of(), history, EVEN)
    assert caught.value.path == "poses"


@pytest.mark.parametrize("pose", [(0.3, 0.3, 0.0), (-50.0, 0.1, 0.0), (1e300, 0.1, 0.0)])
def test_a_later_pose_in_collision_is_answered_and_flagged(pose):
    shield = shield_of(policy=Scripted(REACH, waits))
    decision = decide(shield, [START, np.array(pose)], EVEN)
    assert decision.in_collision
    assert np.isfinite(decision.next_poses).all()
    assert not decide(shield, [START], EVEN).in_collision


@pytest.mark.parametrize(
    ("config", "path", "error"),
    [
        ({"threshold": 0.0}, "threshold", InputError),
        ({"threshold": 1.01}, "threshold", InputError),
        ({"threshold": math.nan}, "threshold", InputError),
        ({"threshold": math.inf, "evaluation": "robustness"}, "threshold", InputError),
        ({"evaluation": "vibes"}, "evaluation", InputError),
        ({"margin": -0.1}, "margin", InputError),
        ({"margin": math.inf}, "margin", InputError),
    ],
)
def test_bad_settings(config, path, error):
    with pytest.raises(error) as caught:
        Config(**config)
    assert caught.value.path == path
    assert Config(threshold=-3.0, evaluation="robustness").threshold == -3.0


def test_policies_of_one_task():
    other = cells_of("F[0,4] A", lambda s: s["A"].any(-1))
    with pytest.raises(PolicyError) as caught:
        make_shield([Exhaustive(REACH), Exhaustive(other)])
    assert caught.value.path == "policy_ids[1]"
    with pytest.raises(PolicyError):
        make_shield([])


def test_several_policies_certify_together():
    """What one of them can do is enough, action by action."""
    goes, comes_back = Scripted(REACH, lambda t, m: [FORWARD]), Scripted(REACH, lambda t, m: [RIGHT, FORWARD])
    assert decide(make_shield([goes]), [START], EVEN).j_values[:MOTIONS] == (1.0, 0.0, 0.0, 1.0)
    assert decide(make_shield([comes_back]), [START], EVEN).j_values[:MOTIONS] == (1.0, 1.0, 0.0, 0.0)
    assert decide(make_shield([goes, comes_back]), [START], EVEN).j_values[:MOTIONS] == (1.0, 1.0, 0.0, 1.0)


class Meddler:
    """A preference that writes into what it is given, and returns these weights."""

    def __init__(self, weights):
        self.weights = weights

    def begin(self):
        return b""

    def step(self, memory, history, signals, log_prior, feasible):
        history[:], log_prior[:], feasible[:] = 0.0, 0.0, True
        return b"", self.weights


@pytest.mark.parametrize("weights", [np.zeros(5), np.full(5, np.nan), np.array([0, np.inf, 0, 0, 0.0]), None])
def test_no_preference_makes_an_action_feasible(weights):
    plain = make_shield([Scripted(REACH, waits)])
    history, logits = np.array([REACH.pose(0, 0, 0)]), np.zeros(5)
    usual = decide(plain, history, logits)
    found = decide(replace(plain, preference=Meddler(weights)), history, logits)
    assert 0.0 in usual.distribution
    assert found.distribution.tolist() == usual.distribution.tolist()
    fit = weights is not None and bool(np.all(weights < np.inf))
    assert any("weights" in said for said in found.warnings) is not fit


@pytest.mark.parametrize("over", ["step", "episode"])
def test_a_preference_weighs_the_feasible_actions(over):
    goes, comes_back = Scripted(REACH, lambda t, m: [FORWARD]), Scripted(REACH, lambda t, m: [RIGHT, FORWARD])
    plain, weights = (
        make_shield([goes, comes_back], Config(threshold_over=over)),
        np.array([0, -1, 0, -2, 0.0]),
    )
    usual = decide(plain, [START], EVEN).distribution
    found = decide(replace(plain, preference=Meddler(weights)), [START], EVEN).distribution
    going_on = usual[:MOTIONS] * np.exp(weights[:MOTIONS])
    assert found[MOTIONS] == usual[MOTIONS]
    np.testing.assert_allclose(found[:MOTIONS], going_on / going_on.sum() * (1.0 - usual[MOTIONS]))
