"""Baselines on cells of 0.2 m (tests/oracles/cells.py), worked out by hand and by enumeration."""

import math

import numpy as np
import pytest

from evaluation.baselines import Completed, RuleFirst, Switching, VisitsFirst, breaks_now, met
from evaluation.decoding import HardDecoding
from evaluation.methods import Decoding
from specshield.episode import make_shield
from specshield.shield.shaping import log_softmax
from tests.oracles.cells import END, FORWARD, RIGHT, WAIT, Cells, Exhaustive

CELLS = Cells(
    "F[0,4] A and G[0,5] not B",
    lambda s: s["A"][..., :5].any(-1) & ~s["B"].any(-1),
    {"A": (2, 0), "B": (3, 0)},
)


class Forwards:
    """Of the futures that keep the rule, always the one that drives on soonest."""

    def choice(self, good):
        return good[0]


PROPOSER = Exhaustive(CELLS)
PROPOSER.random = Forwards()
SHIELD = make_shield([PROPOSER])
STAY, LEAVE = np.array([-3.0, -3.0, -3.0, 3.0, -3.0]), np.array([0.0, 0.0, 0.0, 0.0, 9.0])


def episode(method, logits, draws, most=8):
    """The history and the answers; logits: a function of t. The model says nothing after its `end`."""
    history, answers, over = [CELLS.pose(0, 0, 0)], [], False
    method.begin(0)
    for t in range(most):
        answers.append(method.act(np.array(history), None if over else logits(t), draws[t]))
        over |= answers[-1].action == END
        if answers[-1].execute is None or (over and answers[-1].spec_status != "pending"):
            break
        history.append(CELLS.pose(*CELLS.after(CELLS.state(history[-1]), answers[-1].execute)))
    return np.array(history), answers


def kept(history):
    still = np.repeat(history[-1:], max(CELLS.task.horizon + 1 - len(history), 0), 0)
    return CELLS.kept(np.concatenate([history, still]))


def test_rule_first_follows_the_plan_whatever_the_model_wants_and_then_lets_it_go():
    method = RuleFirst(SHIELD)
    history, answers = episode(method, lambda t: LEAVE, [0.99] * 8)
    assert [a.mode for a in answers] == ["completion"] * 5 + ["prior"]  # decided at t = 5
    assert kept(history)
    assert all(a.action != END for a in answers[:5])
    assert [a.kl for a in answers[:5]] == pytest.approx([9.0 + math.log1p(4.0 * math.exp(-9.0))] * 5)
    assert (answers[5].action, answers[5].kl) == (END, pytest.approx(0.0))
    np.testing.assert_allclose(answers[5].distribution, np.exp(log_softmax(LEAVE)))


def test_visits_first_hands_over_to_the_shield_once_the_visits_are_made():
    """A is met at t = 2; from there on the model is free but for B, until the rule is decided at t = 5."""
    onwards = np.array([9.0, 0.0, 0.0, 0.0, 0.0])
    history, answers = episode(VisitsFirst(SHIELD), lambda t: onwards, [0.5] * 8)
    assert [a.mode for a in answers[:6]] == [
        "completion",
        "completion",
        "shaped",
        "shaped",
        "shaped",
        "prior",
    ]
    assert answers[0].kl == pytest.approx(math.log1p(4.0 * math.exp(-9.0)))
    assert answers[2].distribution[FORWARD] == 0.0  # B is ahead
    assert kept(history)
    _, ended = episode(VisitsFirst(SHIELD), lambda t: LEAVE, [0.99] * 8)
    assert [a.action == END for a in ended[:3]] == [False, False, True]


@pytest.mark.parametrize("completes", [False, True])
def test_hcd_stands_still_after_the_end_and_hcd_plus_goes_on(completes):
    plain = Decoding(CELLS.task, HardDecoding(CELLS.task))
    method = Completed(plain, SHIELD) if completes else plain
    history, answers = episode(method, lambda t: LEAVE if t == 1 else STAY, [0.5] * 8)
    assert [answers[i].action for i in (0, 1)] == [WAIT, END]
    np.testing.assert_array_equal(answers[1].distribution, plain.act(history[:2], LEAVE, 0.5).distribution)
    assert kept(history) is completes
    assert (answers[1].execute, answers[1].spec_status) == (
        (FORWARD, "pending") if completes else (None, None)
    )
    if completes:
        assert {a.mode for a in answers[2:5]} == {"completion"}


def test_switching_hands_back_once_the_obligation_is_met():
    """Two strides to A: the model may wait to t = 2, and the plan then drives to t = 4."""
    _, answers = episode(Switching(SHIELD), lambda t: STAY, [0.5] * 8)
    assert [a.execute for a in answers[:5]] == [WAIT, WAIT, FORWARD, FORWARD, WAIT]
    assert [a.mode for a in answers[:5]] == ["shaped", "shaped", "switched", "switched", "shaped"]
    prior = np.exp(log_softmax(STAY))
    for answer in answers[2:4]:
        assert answer.distribution[END] == pytest.approx(prior[END])
        assert answer.distribution[FORWARD] == pytest.approx(1.0 - prior[END])


def test_switching_takes_one_step_for_a_guard_and_the_drive_for_a_deadline():
    history = np.array([CELLS.pose(i, 0, 0) for i in (0, 1, 2)])
    assert (met(CELLS.task, history[:2]), met(CELLS.task, history)) == (0, 1)
    assert breaks_now(CELLS.task, history, CELLS.pose(3, 0, 0))
    assert not breaks_now(CELLS.task, history, CELLS.pose(2, 0, 0))
    onwards = np.array([9.0, 0.0, 0.0, 0.0, 0.0])  # to A, and then into B
    method = Switching(SHIELD)
    path, answers = episode(method, lambda t: onwards, [0.5] * 8)
    assert [a.execute for a in answers[:2]] == [FORWARD, FORWARD]
    assert kept(path)
    method.begin(0)
    assert method.act(history, onwards, 0.5).mode == "switched"
    turn = np.array([0.0, 0.0, 9.0, 0.0, 0.0])
    beside = np.concatenate([history, history[-1:]])
    assert (again := method.act(beside, turn, 0.5)).mode == "shaped"
    assert again.execute == RIGHT


def test_switching_and_rule_first_keep_the_rule_with_any_model():
    random = np.random.default_rng(0)
    keeping = (Switching, RuleFirst, VisitsFirst)
    for make in (*keeping, lambda shield: Completed(Decoding(CELLS.task), shield)):
        outcomes = []
        for _ in range(40):
            table = 2.0 * random.normal(size=(9, 5))
            history, _ = episode(make(SHIELD), lambda t, table=table: table[t], random.random(9))
            outcomes.append(kept(history))
        assert all(outcomes) is (make in keeping)
