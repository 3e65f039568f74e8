"""Rolling the known dynamics forward under a Q-network: what pi_phi would do after each first motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import inlined, kernel, leaf
from specshield.policy.detour import copy_way, find_sibling, find_twins, join
from specshield.policy.dqn.network import Network, greedy
from specshield.policy.dqn.observation import Sight, observe, outcome
from specshield.robot.dynamics import Body, motion_count, step, successors
from specshield.rule.progress import (
    BROKEN,
    PENDING,
    SETTLED,
    STACK,
    Rules,
    advance,
    read_predicates,
    recall,
    value_count,
)


class State(NamedTuple):
    """Where a rollout is, and scratch. K obligations, M motions."""

    pose: NDArray[np.float64]  # [3]
    status: NDArray[np.int8]  # [K]
    run: NDArray[np.int64]  # [K]
    predicates: NDArray[np.float64]  # [K] at `pose`
    nexts: NDArray[np.float64]  # [M, 3]
    values: NDArray[np.float64]
    stack: NDArray[np.float64]
    after: NDArray[np.float64]  # [K]
    observation: NDArray[np.float32]
    h1: NDArray[np.float32]
    h2: NDArray[np.float32]
    q: NDArray[np.float32]  # [M]


@kernel
def _make_state(body: Body, rules: Rules, net: Network) -> State:
    count = rules.kind.shape[0]
    return State(
        np.empty(3),
        np.empty(count, np.int8),
        np.empty(count, np.int64),
        np.empty(count),
        np.empty((motion_count(body), 3)),
        np.empty(value_count(rules)),
        np.empty(STACK),
        np.empty(count),
        np.empty(net.w1.shape[0], np.float32),
        np.empty(net.b1.shape[0], np.float32),
        np.empty(net.b2.shape[0], np.float32),
        np.empty(net.b3.shape[0], np.float32),
    )


@leaf
def _begin(
    rules: Rules, pose: NDArray[np.float64], status: NDArray[np.int8], run: NDArray[np.int64], state: State
) -> None:
    """Puts a rollout at x_t; status, run (K,): the progress after it."""
    for i in range(3):
        state.pose[i] = pose[i]
    for k in range(status.shape[0]):
        state.status[k], state.run[k] = status[k], run[k]
    read_predicates(rules, pose[0], pose[1], pose[2], state.values, state.stack, state.predicates)


@inlined
def _arrive(rules: Rules, t: int, x: float, y: float, theta: float, state: State) -> None:
    """Takes the state at step t into a rollout."""
    state.pose[0], state.pose[1], state.pose[2] = x, y, theta
    read_predicates(rules, x, y, theta, state.values, state.stack, state.predicates)
    advance(rules, t, state.predicates, state.status, state.run)


@leaf
def _is_pending(status: NDArray[np.int8]) -> bool:
    pending = False
    for k in range(status.shape[0]):
        pending = pending or status[k] == PENDING
    return pending


@leaf
def _follow(
    body: Body,
    rules: Rules,
    sight: Sight,
    net: Network,
    t: int,
    first: int,
    wait: int,
    state: State,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> int:
    """pi_phi from `state` at step t to the horizon, after the motion `first` (-1: pi_phi chooses that too).

    wait: a motion that leaves the pose alone, -1 if there is none; once no obligation is pending the robot
    waits. One that is broken does not end the rest. Writes motions (T - t,) and the poses after each (T - t,
    3). Returns the progress reached: PENDING, SETTLED or BROKEN.
    """
    moved = True
    for k in range(motions.shape[0]):
        if k == 0 and first >= 0:
            motion = first
            x, y, theta = step(body, state.pose[0], state.pose[1], state.pose[2], first)
        elif wait >= 0 and not _is_pending(state.status):
            _stay(state, k, wait, motions, poses)
            break
        else:
            if moved:
                successors(body, state.pose, state.nexts)
            observe(
                body, rules, sight, t + k, state.pose, state.status, state.run, state.predicates, state.nexts,
                state.values, state.stack, state.after, state.observation,
            )  # fmt: skip
            motion = greedy(net, state.observation, state.h1, state.h2, state.q)
            x, y, theta = state.nexts[motion, 0], state.nexts[motion, 1], state.nexts[motion, 2]
            moved = x != state.pose[0] or y != state.pose[1] or theta != state.pose[2]
        _arrive(rules, t + k + 1, x, y, theta, state)
        motions[k] = motion
        poses[k, 0], poses[k, 1], poses[k, 2] = x, y, theta
    return outcome(state.status)


@leaf
def _stay(state: State, k: int, wait: int, motions: NDArray[np.int64], poses: NDArray[np.float64]) -> None:
    """The robot waits from the k-th motion to the horizon."""
    for j in range(k, motions.shape[0]):
        motions[j] = wait
        poses[j, 0], poses[j, 1], poses[j, 2] = state.pose[0], state.pose[1], state.pose[2]


@leaf
def _is_at(pose: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return bool(pose[0] == other[0] and pose[1] == other[1] and pose[2] == other[2])


@leaf
def _retrace(
    body: Body,
    rules: Rules,
    t: int,
    wait: int,
    state: State,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> int:
    """Goes by `motions` (T - t,) from `state`, to where something breaks or, for a robot that can wait, all
    is settled. Other arguments and result as `_follow`.
    """
    x, y, theta = state.pose[0], state.pose[1], state.pose[2]
    for k in range(motions.shape[0]):
        x, y, theta = step(body, x, y, theta, motions[k])
        _arrive(rules, t + k + 1, x, y, theta, state)
        poses[k, 0], poses[k, 1], poses[k, 2] = x, y, theta
        reached = outcome(state.status)
        if reached == SETTLED and wait >= 0:
            _stay(state, k + 1, wait, motions, poses)
            break
        if reached == BROKEN:
            break
    return outcome(state.status)


@kernel
def rollout(
    body: Body,
    rules: Rules,
    sight: Sight,
    net: Network,
    pose: NDArray[np.float64],
    t: int,
    status: NDArray[np.int8],
    run: NDArray[np.int64],
    first: int,
    wait: int,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> int:
    """pi_phi from (x_t, t) as in `_follow`. status, run (K,): the progress after x_t, left as they are."""
    state = _make_state(body, rules, net)
    _begin(rules, pose, status, run, state)
    return _follow(body, rules, sight, net, t, first, wait, state, motions, poses)


@kernel
def propose_all(
    body: Body,
    rules: Rules,
    sight: Sight,
    net: Network,
    past: float,
    history: NDArray[np.float64],
    signals: NDArray[np.float64],
    wait: int,
    undoing: NDArray[np.int64],
    literal: bool,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> int:
    """A continuation a first motion, into motions (M, T - t) and poses (M, T - t, 3); returns pi_phi's own.

    history (t + 1, 3), signals (t + 1, S); rules.signals is left at the last row. past: the margin that
    history is judged by. undoing (M, 2): the motions that undo each, -1: no more is needed. Where `literal`,
    every row is pi_phi's own rollout. Else, once one row settles everything, it is enough for another motion
    to come onto its way, from the same place or by undoing; where that fails it is pi_phi's own rollout too.
    """
    t, count = history.shape[0] - 1, rules.kind.shape[0]
    status, run = np.empty(count, np.int8), np.empty(count, np.int64)
    recall(rules, past, history, signals, status, run)
    state = _make_state(body, rules, net)
    _begin(rules, history[t], status, run, state)
    _follow(body, rules, sight, net, t, -1, wait, state, motions[0, :1], poses[0, :1])
    preferred, base, ways = motions[0, 0], -1, 0
    for m in range(motions.shape[0]):
        x, y, theta = step(body, history[t, 0], history[t, 1], history[t, 2], m)
        motions[m, 0] = m
        poses[m, 0, 0], poses[m, 0, 1], poses[m, 0, 2] = x, y, theta
    twin, known = np.empty(motions.shape[0], np.int64), np.empty(motions.shape[0], np.int64)
    sibling = np.empty(3, np.int64)
    find_twins(poses, twin)
    for i in range(-1, motions.shape[0]):
        m = twin[preferred if i < 0 else i]
        if i >= 0 and (m != i or m == twin[preferred]):
            continue
        reached = PENDING
        if base >= 0 and not literal:
            find_sibling(body, poses, known[:ways], m, wait >= 0, sibling)
            if sibling[0] >= 0:
                join(sibling[1], -1, motions[sibling[0]], sibling[2], wait, motions[m])
                _begin(rules, history[t], status, run, state)
                reached = _retrace(body, rules, t, wait, state, motions[m], poses[m])
            if reached != SETTLED:
                turn, move = undoing[m, 0], undoing[m, 1]
                if _is_at(poses[m, 0], history[t]):  # contact held it: there is nothing to undo
                    turn, move = -1, -1
                join(turn, move, motions[base], 0, wait, motions[m])
                _begin(rules, history[t], status, run, state)
                reached = _retrace(body, rules, t, wait, state, motions[m], poses[m])
        if reached != SETTLED:
            _begin(rules, history[t], status, run, state)
            reached = _follow(body, rules, sight, net, t, m, wait, state, motions[m], poses[m])
            if reached == SETTLED:
                known[ways] = m
                ways += 1
        if reached == SETTLED and base < 0:
            base = m
    for m in range(motions.shape[0]):
        if twin[m] != m:
            copy_way(motions, poses, twin[m], m)
    return int(preferred)


@kernel
def satisfies(
    body: Body,
    rules: Rules,
    sight: Sight,
    net: Network,
    starts: NDArray[np.float64],
    first: bool,
    wait: int,
) -> NDArray[np.bool_]:
    """Whether pi_phi settles the formula from each start (N, 3) at t = 0; with `first`, after some first
    motion.
    """
    out = np.zeros(starts.shape[0], np.bool_)
    motions, poses = np.empty(sight.horizon, np.int64), np.empty((sight.horizon, 3))
    status, run = np.zeros(rules.kind.shape[0], np.int8), np.zeros(rules.kind.shape[0], np.int64)
    state = _make_state(body, rules, net)
    for i in range(starts.shape[0]):
        status[:] = PENDING
        run[:] = 0
        _begin(rules, starts[i], status, run, state)
        advance(rules, 0, state.predicates, status, run)
        for m in range(-1, motion_count(body) if first else 0):
            _begin(rules, starts[i], status, run, state)
            if _follow(body, rules, sight, net, 0, m, wait, state, motions, poses) == SETTLED:
                out[i] = True
                break
    return out
