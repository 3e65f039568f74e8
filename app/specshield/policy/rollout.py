"""Rolling the known dynamics forward under a Q-network: what pi_phi would do after each first motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel
from specshield.policy.network import Network, greedy
from specshield.policy.observation import Sight, observe, outcome
from specshield.policy.progress import PENDING, STACK, Rules, advance, read_predicates, value_count
from specshield.robot.unicycle import Body, successors


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
    """pi_phi from (x_t, t) to the horizon, after the motion `first` (-1: pi_phi chooses that one too).

    status, run (K,): the progress after x_t, left as they are. wait: a motion that leaves the pose alone, -1
    if there is none; once no obligation is pending the robot waits. One that is broken does not end the rest.
    Writes motions (T - t,) and the poses after each (T - t, 3). Returns the progress reached: PENDING,
    SETTLED or BROKEN.
    """
    status, run = status.copy(), run.copy()
    here = pose.copy()
    nexts = np.empty((body.translate.shape[0], 3))
    values, stack = np.empty(value_count(rules)), np.empty(STACK)
    predicates, after = np.empty(rules.kind.shape[0]), np.empty(rules.kind.shape[0])
    observation = np.empty(net.w1.shape[0], np.float32)
    h1, h2 = np.empty(net.b1.shape[0], np.float32), np.empty(net.b2.shape[0], np.float32)
    q = np.empty(net.b3.shape[0], np.float32)
    for k in range(motions.shape[0]):
        if k == 0 and first >= 0:
            motion = first
            successors(body, here, nexts)
        elif wait >= 0 and not np.any(status == PENDING):
            motions[k:] = wait
            for j in range(k, motions.shape[0]):
                poses[j] = here
            break
        else:
            successors(body, here, nexts)
            read_predicates(rules, here[0], here[1], here[2], values, stack, predicates)
            observe(
                body,
                rules,
                sight,
                t + k,
                here,
                status,
                run,
                predicates,
                nexts,
                values,
                stack,
                after,
                observation,
            )
            motion = greedy(net, observation, h1, h2, q)
        motions[k] = motion
        here[:] = nexts[motion]
        poses[k] = here
        read_predicates(rules, here[0], here[1], here[2], values, stack, predicates)
        advance(rules, t + k + 1, predicates, status, run)
    return outcome(status)


@kernel
def rollout_all(
    body: Body,
    rules: Rules,
    sight: Sight,
    net: Network,
    pose: NDArray[np.float64],
    t: int,
    status: NDArray[np.int8],
    run: NDArray[np.int64],
    wait: int,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> None:
    """One rollout a first motion. motions (M, T - t), poses (M, T - t, 3)."""
    for m in range(motions.shape[0]):
        rollout(body, rules, sight, net, pose, t, status, run, m, wait, motions[m], poses[m])


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
    values, stack, predicates = np.empty(value_count(rules)), np.empty(STACK), np.empty(rules.kind.shape[0])
    for i in range(starts.shape[0]):
        status[:] = PENDING
        run[:] = 0
        read_predicates(rules, starts[i, 0], starts[i, 1], starts[i, 2], values, stack, predicates)
        advance(rules, 0, predicates, status, run)
        for m in range(-1, body.translate.shape[0] if first else 0):
            if rollout(body, rules, sight, net, starts[i], 0, status, run, m, wait, motions, poses) == 1:
                out[i] = True
                break
    return out
