"""The shield against every future of a small world."""

from __future__ import annotations

import numpy as np
import pytest

from specshield.episode import decide, make_shield, start
from specshield.errors import InfeasibleStart
from specshield.stl import robustness
from tests.oracles.cells import END, MOTIONS, ROBOT, Cells, Exhaustive, Scripted, waits

REGIONS = {"A": (2, 0), "B": (0, 2), "C": (1, 2)}
WORLDS = {
    "visits": Cells(
        "F[0,4] A and F[4,7] B and G[0,7] not C",
        lambda s: s["A"][..., :5].any(-1) & s["B"][..., 4:].any(-1) & ~s["C"].any(-1),
        {"A": (1, 0), "B": (0, 1), "C": (0, 2)},
    ),
    "stay": Cells(
        "F[1,3] G[1,3] A and F[0,6] not B",
        lambda s: np.any([s["A"][..., k + 1 : k + 4].all(-1) for k in range(1, 4)], axis=0) & ~s["B"].all(-1),
        {"A": (2, 2), "B": (0, 0)},
    ),
    "until": Cells(  # outside the fragment of policies, not of the shield
        "not A U[2,6] B or F[0,6] C and not G[0,3] not A",
        lambda s: (
            np.any([s["B"][..., k] & ~s["A"][..., :k].any(-1) for k in range(2, 7)], axis=0)
            | (s["C"].any(-1) & s["A"][..., :4].any(-1))
        ),
        {"A": (1, 0), "B": (2, 0), "C": (2, 2)},
    ),
}
EACH = pytest.mark.parametrize("cells", WORLDS.values(), ids=list(WORLDS))


def starts(cells):
    return [cells.pose(i, j, h) for i, j in ((0, 0), (0, 1), (2, 1), (2, 2)) for h in range(4)]


@EACH
def test_s_t_is_the_exact_feasible_set_all_along_random_ways(cells):
    """The set by enumeration, whatever the history: also where the formula is lost or settled."""
    random, shield = np.random.default_rng(1), make_shield([Exhaustive(cells)])
    seen = set()
    for pose in starts(cells):
        history, carry = [pose], None
        for _ in range(cells.task.horizon):
            decision = decide(shield, history, np.zeros(5), carry=carry)
            expected = cells.feasible(history)
            if decision.mode in ("shaped", "fallback"):
                assert decision.j_values == (*expected.astype(float), float(expected.any()))
                assert [r > 0 for r in decision.robustness[:MOTIONS]] == expected.tolist()
            elif decision.mode == "prior":
                assert cells.futures(history)[1].all()
            else:
                assert decision.mode == "violated"
                assert not expected.any()
                assert decision.spec_status == "violated"
            seen.add(decision.mode)
            motion = int(random.integers(0, MOTIONS))
            reached = cells.pose(*cells.after(cells.state(history[-1]), motion))
            np.testing.assert_allclose(decision.next_poses[motion], reached, atol=1e-9)
            history, carry = [*history, decision.next_poses[motion]], decision.carry
        assert decide(shield, history, np.zeros(5)).spec_status == (
            "satisfied" if cells.kept(history) else "violated"
        )
    assert len(seen) >= 3


def episode(cells, shield, pose, random, forget=False):
    """One episode of a model that knows nothing of the rule; the caller draws its own actions."""
    history, carry, done, decisions = [pose], None, False, []
    while len(history) <= cells.task.horizon:
        logits = random.normal(0, 3, 5)
        logits[random.random(5) < 0.2] = -np.inf
        if not np.isfinite(logits).any():
            logits[:] = 0.0
        decision = decide(shield, history, None if done else logits, done, carry=carry)
        decisions.append(decision)
        action = int(random.choice(5, p=decision.distribution))
        if action == END:
            done = True
            if decision.completion_action is None:
                break
            action = decision.completion_action
        if decision.finished:
            break
        history.append(decision.next_poses[action])
        carry = None if forget else decision.carry
    while len(history) <= cells.task.horizon:
        history.append(history[-1])
    return history, decisions


@EACH
def test_once_feasible_always_feasible(cells):
    """From every feasible start the closed loop keeps the formula, whatever the model wants."""
    random, modes, played = np.random.default_rng(2), set(), 0
    shield = make_shield([Exhaustive(cells)])
    for pose in starts(cells) * 2:
        if not cells.feasible([pose]).any():
            with pytest.raises(InfeasibleStart) as caught:
                start(shield, pose)
            assert caught.value.path == "initial_pose"
            continue
        start(shield, pose)
        history, decisions = episode(cells, shield, pose, random)
        assert cells.kept(history)
        assert robustness(cells.task.formula, cells.task.samples(np.array(history))) > 0
        assert all(d.reason != "infeasible" for d in decisions)
        modes |= {d.mode for d in decisions}
        played += 1
    assert played >= 8
    assert {"shaped", "completion"} <= modes <= {"shaped", "completion", "prior", "fallback"}


def test_the_witness_carries_a_policy_that_fails_later():
    """A proposer that is perfect once and talks nonsense ever after: the witness alone keeps the formula."""
    cells, random, played = WORLDS["visits"], np.random.default_rng(3), 0

    class Once(Exhaustive):
        def propose(self, history, signals, margin):
            if len(history) == 1:
                return super().propose(history, signals, margin)
            return Scripted(cells, waits).propose(history, signals, margin)

    shield = make_shield([Once(cells)])
    for pose in starts(cells) * 3:
        if cells.feasible([pose]).any():
            history, _ = episode(cells, shield, pose, random)
            assert cells.kept(history)
            played += 1
    assert played >= 10
    lost = [
        episode(cells, shield, p, random, forget=True)[0] for p in starts(cells) if cells.feasible([p]).any()
    ]
    assert not all(cells.kept(history) for history in lost)  # without it, it would not


def test_a_robot_alone_with_its_witness_finishes():
    cells = WORLDS["visits"]
    shield = make_shield([Exhaustive(cells, 4)])
    for pose in starts(cells):
        if not cells.feasible([pose]).any():
            continue
        decision = decide(shield, [pose], np.zeros(5), witnesses=True)
        for action, witness in enumerate(decision.witnesses):
            assert (witness is not None) == (decision.j_values[action] == 1.0 and action != END)
            if witness is None:
                continue
            history, state = [pose], cells.state(pose)
            for motion in (action, *witness):
                assert not ROBOT.actions[motion].terminal
                state = cells.after(state, motion)
                history.append(cells.pose(*state))
            assert len(history) == cells.task.horizon + 1
            assert cells.kept(history)
        executed = decision.completion_action if decision.action == END else decision.action
        assert decision.witness == decision.witnesses[executed]
