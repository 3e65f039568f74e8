"""Methods on cells of 0.2 m, worked out by hand (tests/episode/test_algorithm.py has the map)."""

import math

import numpy as np
import pytest

from evaluation.decoding import HardDecoding, RobustDecoding
from evaluation.methods import Decoding, Shielded, Simplex, drawn
from specshield.episode import decide, make_shield
from specshield.shield.shaping import log_softmax
from tests.oracles.cells import END, FORWARD, LEFT, RIGHT, WAIT, Cells, Exhaustive

CELLS = Cells(
    "F[0,2] A and G[0,4] not B",
    lambda s: s["A"][..., :3].any(-1) & ~s["B"].any(-1),
    {"A": (1, 0), "B": (2, 0)},
)
LOGITS = np.array([0.5, -1.0, 0.0, 2.0, -0.5])


def walk(*motions, start=(0, 0, 0)):
    history = [CELLS.pose(*start)]
    for motion in motions:
        history.append(CELLS.pose(*CELLS.after(CELLS.state(history[-1]), motion)))
    return np.array(history)


@pytest.mark.parametrize(
    ("history", "left"),
    [
        (walk(), {FORWARD, LEFT, RIGHT, WAIT, END}),  # A can wait
        (walk(WAIT), {FORWARD}),  # its last step: whoever stands still, `end` too, has missed it
        (walk(FORWARD), {LEFT, RIGHT, WAIT, END}),  # B is the next cell
        (walk(WAIT, WAIT), {FORWARD, LEFT, RIGHT, WAIT, END}),  # missed: nothing to lose but B
        (walk(FORWARD, FORWARD), {FORWARD}),  # inside B: out of it
        (walk(FORWARD, FORWARD, RIGHT), {FORWARD, LEFT, RIGHT, WAIT, END}),  # and no way out at once
        (walk(FORWARD, WAIT, WAIT, WAIT), {FORWARD, LEFT, RIGHT, WAIT, END}),  # the horizon is past
    ],
)
def test_hard_decoding_masks_what_leaves_no_chance_at_the_next_step(history, left):
    changed = HardDecoding(CELLS.task).decode(history, LOGITS)
    assert set(np.flatnonzero(np.isfinite(changed))) == left
    np.testing.assert_array_equal(changed[list(left)], LOGITS[list(left)])


def test_a_window_that_is_lost_lets_nobody_into_what_is_forbidden():
    """A at step 2 is out of reach from beside B, facing it; B is one step ahead."""
    beside = walk(WAIT, start=(3, 0, 2))
    changed = HardDecoding(CELLS.task).decode(beside, LOGITS)
    assert set(np.flatnonzero(np.isneginf(changed))) == {FORWARD}
    answer = Decoding(CELLS.task, HardDecoding(CELLS.task)).act(beside, LOGITS, 0.5)
    assert (answer.mode, answer.distribution[FORWARD]) == ("shaped", 0.0)
    assert answer.kl == pytest.approx(-math.log(1.0 - np.exp(log_softmax(LOGITS))[FORWARD]))


@pytest.mark.parametrize(
    ("history", "rho"),
    [
        # At the centre of a cell it is 0.1 m inside; one cell on, 0.1 m from the next, two on, 0.3 m.
        (walk(), [0.1, -0.1, -0.1, -0.1, -0.1]),  # the smaller of inside A and outside B
        (walk(FORWARD), [-0.1, 0.1, 0.1, 0.1, 0.1]),  # A is had: outside B alone
        (walk(FORWARD, FORWARD), [0.1, -0.1, -0.1, -0.1, -0.1]),
    ],
)
def test_robust_decoding_adds_what_the_next_state_is_worth(history, rho):
    changed = RobustDecoding(CELLS.task, alpha=2.0, beta=3.0).decode(history, LOGITS)
    np.testing.assert_allclose(changed, LOGITS + 3.0 * np.exp(2.0 * np.array(rho)), atol=1e-9)


def test_robust_decoding_asks_nothing_outside_every_window():
    late = Cells("F[3,4] A", None, {"A": (1, 0)})
    assert RobustDecoding(late.task).decode(walk(), LOGITS) is LOGITS
    assert RobustDecoding(late.task).decode(walk(WAIT, WAIT), LOGITS) is not LOGITS
    assert RobustDecoding(CELLS.task).decode(walk(WAIT, WAIT, WAIT, WAIT), LOGITS) is LOGITS


def test_a_draw_picks_by_the_distribution():
    distribution = np.array([0.25, 0.0, 0.5, 0.25, 0.0])
    assert [drawn(distribution, u) for u in (0.0, 0.2, 0.25, 0.7, 0.8, 1.0 - 1e-12)] == [0, 0, 2, 2, 3, 3]
    answer = Decoding(CELLS.task).act(walk(), np.log([0.1, 0.1, 0.1, 0.1, 0.6]), 0.9)
    assert (answer.action, answer.execute, answer.mode) == (END, None, "prior")


def test_simplex_runs_the_models_own_action_wherever_it_is_feasible():
    random, seen = np.random.default_rng(0), set()
    method = Simplex(make_shield([Exhaustive(CELLS)]))
    for history in (walk(), walk(WAIT), walk(FORWARD)):
        feasible = CELLS.feasible(history)
        for _ in range(40):
            logits, draw = 2.0 * random.normal(size=5), random.random()
            method.begin(0)
            answer = method.act(history, logits, draw)
            prior = np.exp(log_softmax(logits))
            own = drawn(prior, draw)
            if own == END:
                assert answer.action == END
                assert feasible[answer.execute]
            elif feasible[own]:
                assert (answer.action, answer.execute, answer.mode) == (own, own, "shaped")
            else:
                assert feasible[answer.action]
                assert answer.mode == "switched"
            seen.add((own == END, answer.mode))
            off = np.append(~feasible, False)
            assert answer.distribution.sum() == pytest.approx(1.0)
            assert np.all(answer.distribution[off] == 0.0)
            kept = ~off & (np.arange(5) != np.argmax(answer.distribution - prior))
            np.testing.assert_allclose(answer.distribution[kept], prior[kept], atol=1e-12)
    assert seen >= {(False, "shaped"), (False, "switched"), (True, "shaped")}


def test_shielded_draws_from_what_the_shield_answers_and_completes_after_the_end():
    shield = make_shield([Exhaustive(CELLS)])
    method = Shielded(shield)
    decision = decide(shield, walk(WAIT), LOGITS)
    answer = method.act(walk(WAIT), LOGITS, 0.999)
    np.testing.assert_allclose(answer.distribution, decision.distribution)
    assert (answer.action, answer.execute) == (END, FORWARD)
    assert answer.kl == pytest.approx(decision.kl)
    over = method.act(walk(WAIT), None, 0.5)
    assert (over.mode, over.execute, over.kl, over.spec_status) == ("completion", FORWARD, None, "pending")
    assert math.isclose(over.robustness, 0.1, abs_tol=1e-9)
