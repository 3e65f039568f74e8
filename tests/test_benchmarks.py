"""The benchmark's four programs are the same algorithm: equal J on the same states."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.decisions import ROUNDING, ask
from benchmarks.episodes import HERE, measure
from benchmarks.plain import Plain
from benchmarks.states import shipped_dqn, starts
from benchmarks.sweep import made_robot
from specshield.episode import decide, make_shield
from specshield.policy.progress import BROKEN, SETTLED, make_rules, replay
from specshield.policy.reachability import policy as reachability
from specshield.robot.dynamics import make_body, simulate
from specshield.sim.cases import load_case
from specshield.stl import SATISFIED_ABOVE, robustness


@pytest.fixture(scope="module", params=["case1", "case2"])
def dqn(request):
    return replace(shipped_dqn(load_case(request.param)), literal=True)


def test_the_plain_batched_version_has_our_robustness(dqn):
    """(b) and (c), along an episode: equal, but where torch, which adds in another order, breaks a tie
    otherwise.
    """
    plain, shield = Plain(dqn), make_shield([dqn])
    motions = dqn.task.robot.representative
    for state in starts(shield, 1, seed=7):
        history = state.history
        for _ in range(2):
            decision = decide(shield, history, np.zeros(len(dqn.task.robot.actions)))
            ours = np.array(decision.robustness, dtype=np.float64)[motions]
            theirs = plain.batched(history)[motions]
            for m in np.flatnonzero(np.abs(theirs - ours) > ROUNDING):
                assert is_tie(plain, dqn, history, m)
            history = np.concatenate([history, decision.next_poses[[decision.action]]])


def is_tie(plain, dqn, history, m):
    """Whether the rollouts of motion m part at a step where the two best Q-values are as good as equal."""
    theirs = plain.rollouts(history, np.array([m]))[0]
    motions = dqn.propose(history, {}, 0.0).motions[m]
    poses = np.empty((len(motions), 3))
    simulate(make_body(dqn.task.robot, dqn.task.grid), history[-1], motions, poses)
    ours = np.concatenate([history, poses])
    parted = int(np.argmax(np.abs(theirs - ours).max(axis=1) > ROUNDING))
    rules = make_rules(dqn.task)
    status, _ = replay(rules, rules.margin, ours[:parted], np.zeros((parted, 0)))
    seen = plain.observe(parted - 1, ours[None, parted - 1], status[None] == SETTLED, status[None] == BROKEN)
    with torch.no_grad():
        second, first = np.sort(plain.network(torch.from_numpy(seen)).numpy()[0])[-2:]
    return first - second < 1e-5 * max(1.0, abs(first))


def test_rtamt_action_by_action_has_our_j(dqn):
    """(a) and (c)."""
    pytest.importorskip("rtamt", reason="rtamt is of the benchmarks' own environment: make bench")
    shield = make_shield([dqn])
    state = starts(shield, 1, seed=3)[0]
    theirs = Plain(dqn).one_by_one(state.history) > SATISFIED_ABOVE
    ours = np.array(decide(shield, state.history, state.logits).j_values, dtype=np.float64) > 0.0
    going = ~dqn.task.robot.terminal
    assert theirs[going].tolist() == ours[going].tolist()


def test_what_reachability_certifies_holds_by_the_plain_dynamics(dqn):
    """(d): each witness, simulated in NumPy, satisfies; so J = 1 means the same for it."""
    task, plain = dqn.task, Plain(dqn)
    shield = make_shield([reachability.synthesise(task)])
    state = starts(shield, 1, seed=5)[0]
    decision = decide(shield, state.history, state.logits, witnesses=True)
    certified = [a for a, j in enumerate(decision.j_values) if j == 1.0 and not task.robot.terminal[a]]
    assert certified
    poses = np.repeat(state.history, len(certified), axis=0)
    trajectory = [poses]
    plans = np.array([[a, *decision.witnesses[a]] for a in certified])
    for step in range(task.horizon):
        poses = plain.world.next_poses(poses, task.robot.motion_of[plans[:, step]])
        trajectory.append(poses)
    rho = robustness(task.formula, plain.samples(np.stack(trajectory, axis=1)))
    assert np.all(rho > SATISFIED_ABOVE)
    assert ask(shield, state, 1) > 0.0


def test_made_robots_have_as_many_distinct_motions_as_they_say():
    assert [len(made_robot(n).motions) for n in (7, 16, 32, 64)] == [7, 16, 32, 64]


def test_two_processes_decide_and_time_the_same_states_of_an_episode():
    found = measure("case1", "reachability", [HERE, HERE], 1, 0)
    assert found["differ"] == 0
    assert found["first"].count(True) == 1
    assert len(found["seconds"][0]) == len(found["seconds"][1]) == len(found["near"]) > 60
    assert 0.0 < np.min(found["seconds"]) <= np.max(found["seconds"]) < np.inf


def test_what_metrics_and_log_cost_a_step_is_measured_on_a_decision():
    command = [sys.executable, "-m", "benchmarks.watch"]
    printed = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True).stdout
    assert len(re.findall(r"^  metrics\.decided +\d+\.\d$", printed, re.MULTILINE)) == 2


def test_what_there_is_not_to_measure_is_told_in_a_line(tmp_path):
    """Decisions that were never made passed for the same; and houses that are not there were a traceback."""
    for module, asked, said in (
        ("digests", ["--only=planer"], "no setting has 'planer' in its name"),
        ("reliability", ["faults", "--rows=keepr"], "there is no 'keepr'; there are server_embedded, "),
        ("houses", [str(tmp_path)], "evaluation/houses.py says how to get ProcTHOR houses"),
    ):
        done = subprocess.run(
            [sys.executable, "-m", f"benchmarks.{module}", *asked], capture_output=True, text=True
        )
        assert done.returncode != 0
        assert said in done.stderr.splitlines()[-1]
        assert "Traceback" not in done.stderr
