"""What is said to hold whatever signals do, against every signal and every way to answer it.

The oracle plays the game: the signals choose their samples, the robot sees them and chooses a motion. It
knows the robot's moves on whole cells (oracles/cells.py) and the rule on booleans, written again by hand.
"""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np
import pytest

from specshield.caution.signals import any_signal
from specshield.caution.worst import worst_signals
from specshield.episode import decide, make_shield
from specshield.policy.planner.policy import Settings, synthesise
from specshield.shield.decision import Config
from specshield.shield.uncertainty import Uncertainty
from tests.oracles.brute_stl import brute_robustness
from tests.oracles.cells import MOTIONS, STATES, Cells

CALL, TWO = {"call": 0.0}, {"left": 0.0, "right": 0.0}


def near(where, region, a, b, t):
    return any(where[k] == region for k in range(t + a, t + b + 1))


A, B, C = (1, 2), (2, 2), (1, 0)
CAUTIOUS = Config(any_signal=True, learn_map=True, uncertainty=Uncertainty())
# keeps(cells, signals): the rule again, on the cell and the signals (those above a half) of each step.
GAMES = {
    "a call": (
        "G[0,3] (call > 0.5 -> F[0,2] A)",
        CALL,
        lambda w, s: all(not s[t][0] or near(w, A, 0, 2, t) for t in range(4)),
    ),
    "a call, and a visit": (
        "G[0,2] (call > 0.5 -> F[0,3] A) and F[2,5] B",
        CALL,
        lambda w, s: all(not s[t][0] or near(w, A, 0, 3, t) for t in range(3)) and near(w, B, 2, 5, 0),
    ),
    "a call, and a place in the way": (
        "G[0,2] (call > 0.5 -> F[1,3] A) and G[0,5] not C",
        CALL,
        lambda w, s: all(not s[t][0] or near(w, A, 1, 3, t) for t in range(3)) and C not in w,
    ),
    "a call, and a patrol": (
        "G[0,2] (call > 0.5 -> F[0,3] A) and G[0,2] F[0,3] B",
        CALL,
        lambda w, s: all((not s[t][0] or near(w, A, 0, 3, t)) and near(w, B, 0, 3, t) for t in range(3)),
    ),
    "two calls": (
        "G[0,1] (left > 0.5 -> F[0,3] A) and G[1,2] (right < -0.5 -> F[0,2] B)",
        TWO,
        lambda w, s: (
            all(not s[t][0] or near(w, A, 0, 3, t) for t in (0, 1))
            and all(not s[t][1] or near(w, B, 0, 2, t) for t in (1, 2))
        ),
    ),
    "a call that forbids": (
        "G[0,3] (call > 0.5 -> G[1,2] not A) and F[3,5] B",
        CALL,
        lambda w, s: (
            all(not s[t][0] or (w[t + 1] != A and w[t + 2] != A) for t in range(4)) and near(w, B, 3, 5, 0)
        ),
    ),
    "a call that only helps": (
        "F[1,4] (call > 0.5 and A or B)",
        CALL,
        lambda w, s: any((s[t][0] and w[t] == A) or w[t] == B for t in range(1, 5)),
    ),
}
# How many samples, from step 0 on, the rule looks at. The later ones are drawn.
LISTENS = {
    "a call": 4,
    "a call, and a visit": 3,
    "a call, and a place in the way": 3,
    "a call, and a patrol": 3,
    "two calls": 3,
    "a call that forbids": 4,
    "a call that only helps": 5,
}
EACH = pytest.mark.parametrize("name", list(GAMES))
STARTS = [(i, j, h) for i, j in ((0, 2), (1, 2), (2, 1), (2, 2)) for h in range(4)]


@lru_cache
def world(name):
    formula, signals, _ = GAMES[name]
    cells = Cells(
        formula, None, {n: c for n, c in zip("ABC", (A, B, C), strict=True) if n in formula}, signals
    )
    policy = synthesise(cells.task, Settings(pitch=0.2))
    return cells, make_shield([policy], Config(any_signal=True)), Game(cells, GAMES[name][2])


class Game:
    """Whether the robot can keep the rule from a history, whatever the signals do."""

    def __init__(self, cells, keeps):
        self.keeps, self.horizon, self.table = keeps, cells.task.horizon, cells.table.tolist()
        self.samples = list(itertools.product((False, True), repeat=len(cells.task.signals)))
        self.known = {}

    def wins(self, state, where, signals):
        """state: an index into STATES; where, signals: the cells and the samples to now, tuples."""
        if len(where) > self.horizon:
            return self.keeps(where, signals)
        key = state, where, signals
        if key not in self.known:
            self.known[key] = any(self.wins_after(m, *key) for m in range(MOTIONS))
        return self.known[key]

    def wins_after(self, motion, state, where, signals):
        after = self.table[state][motion]
        there = (*where, STATES[after][:2])
        return all(self.wins(after, there, (*signals, sample)) for sample in self.samples)


def sent(task, samples):
    """Samples of booleans as the shield takes them: above a half, or, for `right`, below minus a half."""
    return {
        name: np.array([(-1.0 if name == "right" else 1.0) * sample[i] for sample in samples])
        for i, name in enumerate(task.signals)
    }


@EACH
def test_what_is_certified_against_any_signal_wins_the_game_and_nearly_all_that_wins_is(name):
    """Along random ways under random signals, with no witness carried."""
    cells, shield, game = world(name)
    random, claimed, missed = np.random.default_rng(1), 0, 0
    for start in STARTS:
        poses, states, samples = [cells.pose(*start)], [STATES.index(start)], ()
        for _ in range(cells.task.horizon):
            samples = (*samples, game.samples[random.integers(len(game.samples))])
            where = tuple(STATES[state][:2] for state in states)
            decision = decide(shield, poses, np.zeros(5), signals=sent(cells.task, samples))
            wins = [game.wins_after(m, states[-1], where, samples) for m in range(MOTIONS)]
            if decision.any_signal and decision.mode == "shaped":
                feasible = [j == 1.0 for j in decision.j_values[:MOTIONS]]
                assert not any(f and not w for f, w in zip(feasible, wins, strict=True))
                claimed, missed = claimed + sum(feasible), missed + sum(wins) - sum(feasible)
            elif decision.mode == "prior":
                assert all(wins)
            elif not decision.any_signal:
                missed += sum(wins)
            motion = int(random.integers(MOTIONS))
            poses.append(decision.next_poses[motion])
            states.append(int(cells.table[states[-1], motion]))
    assert missed <= 0.08 * claimed  # what the planner does not find: two places within three steps
    assert claimed > 30


@EACH
def test_a_start_that_is_guaranteed_is_kept_under_every_signal_that_there_is(name):
    cells, shield, game = world(name)
    won, played = 0, 0
    for start in STARTS:
        at = STATES.index(start), (start[:2],)
        wins = all(game.wins(*at, (sample,)) for sample in game.samples)
        assert any_signal(shield, cells.pose(*start)[None]) is wins
        if not wins:
            continue
        won += 1
        random = np.random.default_rng(won)
        for n, samples in enumerate(itertools.product(game.samples, repeat=LISTENS[name])):
            rest = random.integers(len(game.samples), size=cells.task.horizon + 1 - len(samples))
            assert _kept(cells, shield, start, (*samples, *(game.samples[i] for i in rest)), n)
            played += 1
    assert played == won * len(game.samples) ** LISTENS[name]
    assert won >= 6


def _kept(cells, shield, start, samples, seed):
    """One episode of a model that knows nothing, judged by the definition of robustness."""
    random, poses, carry, done = np.random.default_rng(seed), [cells.pose(*start)], None, False
    signals = sent(cells.task, samples)
    for t in range(cells.task.horizon):
        now = {name: values[: t + 1] for name, values in signals.items()}
        logits = None if done else random.normal(0, 3, 5)
        decision = decide(shield, poses, logits, done, now, carry)
        assert decision.any_signal
        carry, action = decision.carry, int(random.choice(5, p=decision.distribution))
        if action == 4:
            done, action = True, decision.completion_action
            action = 3 if action is None else action
        poses.append(decision.next_poses[action])
    read = cells.task.samples(np.array(poses), signals)
    return brute_robustness(cells.task.formula, {n: list(v) for n, v in read.items()}) > 0


@pytest.mark.parametrize(
    ("formula", "worst"),
    [
        ("G[0,9] (call > 2.5 -> F[0,3] A)", [[3.5]]),
        ("G[0,9] (call > 2.5 -> F[0,3] A) and G[0,9] (call > 7 -> B)", [[8.0]]),
        ("G[0,9] (call > 1 and call < 2 -> F[0,3] A)", [[1.5]]),
        ("G[0,9] (call / 1000 > 3.3 -> F[0,3] A)", [[1e12]]),
        ("F[0,9] (call > 1 and A)", [[0.0]]),
        ("G[0,9] (call > 1 -> A) and G[0,9] (call < 0.5 -> B)", None),
        ("G[0,9] (call > x -> A)", None),
        ("F[0,9] A", None),
    ],
)
def test_the_worst_values_ask_for_everything_that_can_be_asked_for(formula, worst):
    signals = CALL if "call" in formula else {}
    task = Cells(formula, None, {"A": A, "B": B}, signals).task
    found = worst_signals(task, task.formula)
    assert found is None if worst is None else found is not None
    if worst is not None and worst != [[0.0]]:
        assert found.tolist() == worst


def test_sessions_that_take_signals_to_stay_as_they_are_say_nothing_of_others():
    cells, shield, _ = world("a call")
    silent = make_shield(shield.proposers)
    assert any_signal(silent, cells.pose(1, 2, 0)[None]) is None
    assert decide(silent, [cells.pose(1, 2, 0)], np.zeros(5)).any_signal is None


BATTERIES = [50.0] * 6, [50.0, 50.0, *[9.0] * 4], [50.0, 9.0, *[50.0] * 4]
GUARDED = "G[0,2] (call > 0.5 -> F[0,3] A) and G[0,5] (not C and battery > 10)"


def test_what_no_motion_changes_leaves_the_rest_guarded_against_signals_and_kept_once_it_is_broken():
    """Against every way in which calls can come, with a battery that stays, runs low, or recovers."""
    regions, signals = {"A": A, "C": C}, {"call": 0.0, "battery": 50.0}
    cells = Cells(GUARDED, None, regions, signals)
    rest = Cells("G[0,2] (call > 0.5 -> F[0,3] A) and G[0,5] not C", None, regions, CALL)
    game = Game(rest, lambda w, s: all(not s[t][0] or near(w, A, 0, 3, t) for t in range(3)) and C not in w)
    shield, played = make_shield([synthesise(cells.task, Settings(pitch=0.2))], CAUTIOUS), 0
    for start in STARTS:
        if not all(game.wins(STATES.index(start), (start[:2],), (sample,)) for sample in game.samples):
            continue
        assert any_signal(shield, cells.pose(*start)[None]) is False
        each = itertools.product(itertools.product((0.0, 1.0), repeat=3), BATTERIES)
        for n, (calls, battery) in enumerate(each):
            calls = (*calls, *np.random.default_rng(n).integers(2, size=3))  # at which the rule does not look
            told = {"call": np.array(calls, float), "battery": np.array(battery)}
            random, poses, carry, statuses = np.random.default_rng(n), [cells.pose(*start)], None, []
            for t in range(5):
                now = {name: values[: t + 1] for name, values in told.items()}
                decision = decide(shield, poses, random.normal(0, 3, 5), False, now, carry)
                action = int(random.choice(5, p=decision.distribution))
                moved = decision.completion_action if action == 4 else action
                poses.append(decision.next_poses[moved])
                carry = decision.carry
                statuses.append(decision.spec_status)
                assert not decision.any_signal
            read = rest.task.samples(np.array(poses), {"call": told["call"]})
            assert brute_robustness(rest.task.formula, {k: list(v) for k, v in read.items()}) > 0
            assert ("violated" in statuses) is (min(battery[:5]) < 10)
            played += 1
    assert played > 100
