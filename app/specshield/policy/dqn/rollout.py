"""Rolling the known dynamics forward under a Q-network: what pi_phi would do after each first motion."""

from __future__ import annotations

import numpy as np

from specshield.arrays import Bools, Floats, Ints, copy_row
from specshield.compiled import kernel, leaf
from specshield.policy.detour import copy_ways, find_sibling, find_twins, is_same_pose, join
from specshield.policy.dqn.network import Layers, Network, greedy, make_layers
from specshield.policy.dqn.observation import State, arrive, make_state, observe, outcome, place
from specshield.policy.dqn.scene import Scene
from specshield.policy.progress import BROKEN, PENDING, SETTLED, Past, Present, Rules, advance, recall
from specshield.robot.dynamics import motion_count, step, successors


@leaf
def _begin(rules: Rules, now: Present, state: State) -> None:
    """Puts a rollout at x_t."""
    for k in range(now.status.shape[0]):
        state.status[k], state.run[k] = now.status[k], now.run[k]
    place(rules, now.pose[0], now.pose[1], now.pose[2], state)


@leaf
def _follow(
    scene: Scene, layers: Layers, t: int, first: int, state: State, motions: Ints, poses: Floats, whole: bool
) -> int:
    """Follows pi_phi from `state` at step t to the horizon and returns the outcome there.

    first: the motion to begin with, -1 where pi_phi chooses that too. Writes motions (T - t,) and the pose
    after each, poses (T - t, 3). whole: a broken obligation does not end the rollout, since others may still
    be kept. Once none is pending, a robot that can wait does.
    """
    known = False  # whether state.nexts are those from where the robot is
    for k in range(motions.shape[0]):
        if k == 0 and first >= 0:
            motion = first
            x, y, theta = step(scene.body, state.pose[0], state.pose[1], state.pose[2], first)
        elif scene.wait >= 0 and PENDING not in state.status:
            _stay(state, k, scene.wait, motions, poses)
            break
        else:
            if not known:
                successors(scene.body, state.pose, state.nexts)
            observe(scene, t + k, state)
            motion = greedy(layers, state.observation)
            x, y, theta = state.nexts[motion, 0], state.nexts[motion, 1], state.nexts[motion, 2]
            known = True
        known = not arrive(scene.rules, t + k + 1, x, y, theta, state) and known
        motions[k] = motion
        poses[k, 0], poses[k, 1], poses[k, 2] = x, y, theta
        if not whole and BROKEN in state.status:
            break
    return outcome(state.status)


@leaf
def _stay(state: State, k: int, wait: int, motions: Ints, poses: Floats) -> None:
    """The robot waits from the k-th motion to the horizon."""
    for j in range(k, motions.shape[0]):
        motions[j] = wait
        poses[j, 0], poses[j, 1], poses[j, 2] = state.pose[0], state.pose[1], state.pose[2]


@leaf
def _retrace(scene: Scene, t: int, state: State, motions: Ints, poses: Floats) -> int:
    """Goes by `motions` (T - t,) from `state` and returns the outcome. Writes poses (T - t, 3).

    Stops where an obligation breaks. A robot that can wait does so as soon as all are settled.
    """
    x, y, theta = state.pose[0], state.pose[1], state.pose[2]
    for k in range(motions.shape[0]):
        x, y, theta = step(scene.body, x, y, theta, motions[k])
        arrive(scene.rules, t + k + 1, x, y, theta, state)
        poses[k, 0], poses[k, 1], poses[k, 2] = x, y, theta
        reached = outcome(state.status)
        if reached == SETTLED and scene.wait >= 0:
            _stay(state, k + 1, scene.wait, motions, poses)
            break
        if reached == BROKEN:
            break
    return outcome(state.status)


@kernel
def propose_all(scene: Scene, net: Network, past: Past, undoing: Ints, literal: bool, motions: Ints) -> int:
    """Writes a continuation for each first motion into motions (M, T - t).

    Returns the motion that pi_phi itself takes. If `literal`, every row is pi_phi's own rollout after that
    motion. Otherwise, once some row settles everything, other first motions try to join it: from the same
    place (policy/detour.py) or by undoing the motion. If neither settles everything, pi_phi's own rollout is
    tried. If that breaks the rule too, the row undoes its motion and joins the other way if it can: then it
    misses the rule by a few steps only, while pi_phi often goes astray once it is late.

    undoing (M, 2): the motions that undo each, -1 for none.
    """
    now = recall(scene.rules, past)
    t = now.t
    state, layers = make_state(scene, net.w1.shape[0]), make_layers(net)
    poses = np.empty((*motions.shape, 3))
    _begin(scene.rules, now, state)
    _follow(scene, layers, t, -1, state, motions[0, :1], poses[0, :1], True)
    preferred, base, ways = motions[0, 0], -1, 0
    for m in range(motions.shape[0]):
        x, y, theta = step(scene.body, now.pose[0], now.pose[1], now.pose[2], m)
        motions[m, 0] = m
        poses[m, 0, 0], poses[m, 0, 1], poses[m, 0, 2] = x, y, theta
    twin, known = np.empty(motions.shape[0], np.int64), np.empty(motions.shape[0], np.int64)
    sibling, own = np.empty(3, np.int64), np.empty(motions.shape[1], np.int64)
    find_twins(poses, twin)
    for i in range(-1, motions.shape[0]):  # what pi_phi prefers comes first: others may join it
        m = twin[preferred if i < 0 else i]
        if i >= 0 and (m != i or m == twin[preferred]):
            continue
        reached, joins = PENDING, False
        if base >= 0 and not literal:
            find_sibling(scene.body, poses, known[:ways], m, scene.wait >= 0, sibling)
            if sibling[0] >= 0:
                join(sibling[1], -1, motions[sibling[0]], sibling[2], scene.wait, motions[m])
                _begin(scene.rules, now, state)
                reached = _retrace(scene, t, state, motions[m], poses[m])
            if reached != SETTLED:
                turn, move = undoing[m, 0], undoing[m, 1]
                stands = is_same_pose(poses[m, 0], now.pose)
                if stands:  # it waits, or contact held it: there is nothing to undo
                    turn, move = -1, -1
                joins = stands or turn >= 0 or move >= 0
                join(turn, move, motions[base], 0, scene.wait, motions[m])
                _begin(scene.rules, now, state)
                reached = _retrace(scene, t, state, motions[m], poses[m])
        if reached != SETTLED:
            _begin(scene.rules, now, state)
            row = own if joins else motions[m]
            reached = _follow(scene, layers, t, m, state, row, poses[m], not joins)
            if reached == SETTLED:
                copy_row(row, motions[m])
                known[ways] = m
                ways += 1
        if reached == SETTLED and base < 0:
            base = m
    copy_ways(motions, poses, twin)
    return int(preferred)


@kernel
def satisfies(scene: Scene, net: Network, starts: Floats, first: bool) -> Bools:
    """Whether pi_phi settles the formula from each of starts (N, 3) at t = 0. Shape (N,).

    first: whether any first motion may come before pi_phi.
    """
    count = scene.rules.kind.shape[0]
    out = np.zeros(starts.shape[0], np.bool_)
    motions, poses = np.empty(scene.horizon, np.int64), np.empty((scene.horizon, 3))
    status, run = np.empty(count, np.int8), np.empty(count, np.int64)
    state, layers = make_state(scene, net.w1.shape[0]), make_layers(net)
    for i in range(starts.shape[0]):
        status[:] = PENDING
        run[:] = 0
        now = Present(0, starts[i], status, run)
        _begin(scene.rules, now, state)
        advance(scene.rules, 0, state.predicates, status, run)
        for m in range(-1, motion_count(scene.body) if first else 0):
            _begin(scene.rules, now, state)
            if _follow(scene, layers, 0, m, state, motions, poses, True) == SETTLED:
                out[i] = True
                break
    return out
