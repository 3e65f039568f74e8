"""D at the next poses, by exact steps of the surrogate first: beside a wall the lattice knows little."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel, leaf
from specshield.policy.progress import ALWAYS, STACK, Rules, read_predicates, value_count
from specshield.robot.unicycle import Body, step
from specshield.shield.desirability import NEVER, desirability
from specshield.shield.planes import Planes
from specshield.shield.surrogate import FEATURES, Course, follow, is_blocked

Floats = NDArray[np.float64]

DEPTH = 2  # exact steps before the lattice is asked


@kernel
def expand_all(
    body: Body,
    rules: Rules,
    course: Course,
    planes: Planes,
    table: NDArray[np.uint16],
    since: int,
    style: Floats,
    t: int,
    mask: int,
    x: float,
    y: float,
    theta: float,
    out: Floats,
) -> None:
    """D after each motion from x_t, out (M,). mask: the goals settled at t; since: the table's first step.

    A tree of poses: level d holds the M^d poses at t + d, the children of node n at M n to M n + M - 1.
    """
    motions, horizon = out.shape[0], planes.slot.shape[0] - 2
    levels = min(DEPTH + 1, horizon - t)
    start = np.zeros(levels + 2, np.int64)
    for d in range(levels + 1):
        start[d + 1] = start[d] + motions**d
    pose, settled = np.empty((start[-1], 3)), np.empty(start[-1], np.int64)
    log_r, going_on = np.empty(start[-1]), np.empty(start[-1])
    cost, blocked = np.empty(start[-1]), np.empty(motions, np.bool_)
    features, reaction = np.empty((motions, FEATURES)), np.empty(motions)
    values, stack, read = np.empty(value_count(rules)), np.empty(STACK), np.empty(rules.kind.shape[0])
    pose[0, 0], pose[0, 1], pose[0, 2], settled[0] = x, y, theta, mask
    for d in range(levels):
        for n in range(start[d], start[d + 1]):
            first = start[d + 1] + (n - start[d]) * motions
            u, v, w = pose[n]
            for m in range(motions):
                child = first + m
                settled[child] = -1
                if settled[n] >= 0:
                    pose[child, 0], pose[child, 1], pose[child, 2] = step(body, u, v, w, m)
                    blocked[m] = is_blocked(body, m, u, v, w, pose[child])
                    read_predicates(
                        rules, pose[child, 0], pose[child, 1], pose[child, 2], values, stack, read
                    )
                    settled[child] = _settle(rules, planes, t + d + 1, settled[n], read)
            if settled[n] >= 0:
                going_on[n] = 1.0 - follow(body, course, style, u, v, w, blocked, features, reaction)
                log_r[first : first + motions] = reaction
    for n in range(start[levels], start[levels + 1]):
        u, v, w = pose[n]
        cost[n] = desirability(body, planes, table, since, t + levels, settled[n], u, v, w)
    for d in range(levels - 1, 0, -1):
        for n in range(start[d], start[d + 1]):
            first = start[d + 1] + (n - start[d]) * motions
            least, total = float(NEVER), 0.0
            for child in range(first, first + motions):
                if cost[child] < NEVER:
                    least = min(least, cost[child] - log_r[child])
            for child in range(first, first + motions):
                if cost[child] < NEVER:
                    total += math.exp(least - cost[child] + log_r[child])
            cost[n] = going_on[n] * (least - math.log(total)) if total > 0.0 else float(NEVER)
    out[:] = cost[start[1] : start[2]]


@leaf
def _settle(rules: Rules, planes: Planes, t: int, mask: int, read: Floats) -> int:
    """The goals settled once the state at step t is taken in; -1 where it breaks an `always`."""
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == ALWAYS and rules.a[k] <= t <= rules.b[k] and read[k] <= rules.margin:
            return -1
    for g in range(planes.goal.shape[0]):
        if planes.first[g] <= t <= planes.last[g] and read[planes.goal[g]] > rules.margin:
            mask |= 1 << g
    return mask
