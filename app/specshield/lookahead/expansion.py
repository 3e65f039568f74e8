"""D at the next poses, by a few exact steps of the stand-ins before the lattice is asked.

Beside a wall the coarse lattice knows little of what f does; an exact step does.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Codes, Floats, Ints
from specshield.compiled import kernel, leaf
from specshield.lookahead.desirability import UNKEEPABLE, desirability
from specshield.lookahead.goals import Goals
from specshield.lookahead.lattice import Planes, is_blocked
from specshield.lookahead.surrogate import follow, price_left, step_price
from specshield.policy.progress import ALWAYS, Rules, read_predicates, value_count
from specshield.robot.dynamics import step
from specshield.stl.program import STACK_SIZE

DEPTH = 2  # exact steps before the lattice is asked; chosen by hand, nothing measured


class Bank(NamedTuple):
    """The stand-ins that were solved for a task. leads [B]: the goal of each, or WANDER for the last; tables
    [B, kept, H, rows]: codes of its D.
    """

    rules: Rules
    goals: Goals
    planes: Planes
    leads: Ints
    tables: Codes


@kernel
def expand_all(bank: Bank, asked: Ints, style: Floats, t: int, mask: int, here: Floats, out: Floats) -> None:
    """D after each motion from x_t, into out (K, M), for the K stand-ins asked for, (K,).

    style (FEATURES,): of the stand-ins. mask: the goals of the formula settled at t. The poses form a tree:
    level d holds the M^d poses at t + d, and the children of its node n are nodes M n to M n + M - 1 of the
    next level.
    """
    rules, goals, planes, leads, tables = bank
    motions, horizon = out.shape[1], planes.slot.shape[0] - 2
    levels = min(DEPTH + 1, horizon - t)
    start = np.zeros(levels + 2, np.int64)
    for d in range(levels + 1):
        start[d + 1] = start[d] + motions**d
    pose, settled = np.empty((start[-1], 3)), np.full(start[-1], -1)
    blocked = np.zeros((start[-1], motions), np.bool_)
    values, stack, read = np.empty(value_count(rules)), np.empty(STACK_SIZE), np.empty(rules.kind.shape[0])
    pose[0], settled[0] = here, mask
    for d in range(levels):
        for n in range(start[d], start[d + 1]):
            if settled[n] < 0:
                continue
            u, v, w = pose[n]
            for m in range(motions):
                child = start[d + 1] + (n - start[d]) * motions + m
                x, y, theta = step(planes.body, u, v, w, m)
                blocked[n, m] = is_blocked(planes.body, m, (u, v, w), (x, y, theta))
                pose[child, 0], pose[child, 1], pose[child, 2] = x, y, theta
                read_predicates(rules, x, y, theta, values, stack, read)
                settled[child] = _settle(rules, planes, t + d + 1, settled[n], read)
    cost, log_r = np.empty(start[-1]), np.empty(motions)
    full = planes.slot.shape[1] - 1
    for k in range(asked.shape[0]):
        lead = leads[asked[k]]
        for d in range(levels, 0, -1):
            for n in range(start[d], start[d + 1]):
                cost[n] = float(UNKEEPABLE)
                if settled[n] < 0:
                    continue
                u, v, w = pose[n]
                if d == levels:
                    cost[n] = desirability(planes, tables[asked[k]], t + d, settled[n], u, v, w)
                else:
                    ends = follow(goals, lead, style, (u, v, w), blocked[n], log_r)
                    first = start[d + 1] + (n - start[d]) * motions
                    total = _log_sum(log_r, cost[first : first + motions])
                    if total > -float(UNKEEPABLE):
                        due = step_price(lead) if settled[n] != full else 0.0
                        cost[n] = due - (1.0 - ends) * total
                before = start[d - 1] + (n - start[d]) // motions
                if cost[n] < UNKEEPABLE and settled[n] == full and settled[before] != full:
                    cost[n] += price_left(goals, lead, u, v)
        out[k] = cost[start[1] : start[2]]


@leaf
def _log_sum(log_r: Floats, cost: Floats) -> float:
    """log sum_m r_m exp(-cost_m) over the motions that have a cost; -UNKEEPABLE where none has."""
    least, total = float(UNKEEPABLE), 0.0
    for m in range(cost.shape[0]):
        if cost[m] < UNKEEPABLE:
            least = min(least, cost[m] - log_r[m])
    for m in range(cost.shape[0]):
        if cost[m] < UNKEEPABLE:
            total += math.exp(least - cost[m] + log_r[m])
    return math.log(total) - least if total > 0.0 else -float(UNKEEPABLE)


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
