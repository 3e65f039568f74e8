"""Funnel-shaped rewards (paper, section IV-A, after Saxena, Gorantla and Jagtap, 2024).

    gamma(t) = (gamma_0 - gamma_inf) exp(-l t) + gamma_inf                      (eq. 4)
    r(x_t)   = rho(x_t, predicate) + gamma(t) - rho_max                         (eq. 5)

Two rewards for a conjunction of obligations. `paper`: the minimum of r over the obligations not yet settled,
taken literally. `progress`, the default: the share of goals settled plus the current goal's funnel along free
space, in the minimum with the `always` obligations' robustness, capped: uncapped, the farthest distance from
a forbidden region rules the minimum, and the straight-line distance to a region behind a wall misleads.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import leaf
from specshield.policy.dqn.observation import Sight, current_goal, field_at
from specshield.robot.dynamics import Body
from specshield.rule.progress import ALWAYS, EVENTUALLY_ALWAYS, PENDING, SETTLED, Rules

CAP = 0.15  # [m] robustness of an `always` beyond which more is no better
REST = 0.5  # gamma_inf as a share of its upper limit min(gamma_0, rho_max)


class Funnels(NamedTuple):
    """One funnel an obligation, arrays of shape (K,): eq. 4's parameters and the step its clock starts at."""

    gamma_0: NDArray[np.float64]
    gamma_inf: NDArray[np.float64]
    rate: NDArray[np.float64]
    clock: NDArray[np.int64]
    rho_max: NDArray[np.float64]
    literal: bool


def decay_rate(gamma_0: float, gamma_inf: float, rho_max: float, t_star: float) -> float:
    """Table I's l: the funnel's boundary reaches zero robustness at t_star steps.

    t_star is at least 1 (G[0,b] would divide by zero), and l at least 0 (where min rho > gamma_inf the
    logarithm is negative: the whole space is already inside).
    """
    return max(math.log((gamma_0 - gamma_inf) / (rho_max - gamma_inf)) / max(t_star, 1.0), 0.0)


def make_funnels(
    rules: Rules, sight: Sight, lowest: NDArray[np.float64], highest: NDArray[np.float64], literal: bool
) -> Funnels:
    """Funnels of a task's obligations. lowest, highest (K,): each predicate's robustness over free space.

    Each clock starts at its own window: t* is Table I's, halfway through it, counted from the window's start.
    """
    n = len(rules.kind)
    gamma_0, gamma_inf, rate, rho_max = (np.zeros(n) for _ in range(4))
    clock = np.zeros(n, dtype=np.int64)
    for k in range(n):
        if literal or rules.kind[k] == ALWAYS:
            top, span = max(float(highest[k]), 1e-3), max(float(highest[k] - lowest[k]), 2e-3)
        else:  # along free space: robustness is minus the distance, the top a small radius inside the goal
            reach = sight.distance[sight.goal[k]]
            top, span = CAP, float(np.percentile(reach, 99)) + CAP
        gamma_0[k], rho_max[k] = span, top
        gamma_inf[k] = REST * min(span, top)
        hold = rules.kind[k] == EVENTUALLY_ALWAYS
        clock[k] = rules.a[k] + (rules.c2[k] if hold else 0)
        width = (rules.c1[k] if hold else rules.b[k]) - rules.a[k]
        t_star = 1.0 if rules.kind[k] == ALWAYS else 0.5 * float(width)
        rate[k] = decay_rate(gamma_0[k], gamma_inf[k], rho_max[k], t_star)
    return Funnels(gamma_0, gamma_inf, rate, clock, rho_max, literal)


@leaf
def gamma(funnels: Funnels, k: int, t: int) -> float:
    """Eq. 4 at step t; gamma_0 before the window."""
    elapsed = max(t - funnels.clock[k], 0)
    decayed = (funnels.gamma_0[k] - funnels.gamma_inf[k]) * math.exp(-funnels.rate[k] * elapsed)
    return float(decayed + funnels.gamma_inf[k])


@leaf
def reward(
    body: Body,
    rules: Rules,
    sight: Sight,
    funnels: Funnels,
    t: int,
    pose: NDArray[np.float64],
    status: NDArray[np.int8],
    predicates: NDArray[np.float64],
) -> float:
    """The reward of having come to x_t with this progress. predicates (K,) at x_t."""
    if funnels.literal:
        least = np.inf
        for k in range(rules.kind.shape[0]):
            if status[k] == PENDING:
                least = min(least, predicates[k] + gamma(funnels, k, t) - funnels.rho_max[k])
        return least if least < np.inf else 0.0
    goals, settled, safe = 0, 0, 1.0
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == ALWAYS:
            if status[k] == PENDING and t >= rules.a[k]:
                safe = min(safe, predicates[k] / CAP)
        else:
            goals += 1
            settled += status[k] == SETTLED
    if goals == 0:
        return safe
    done = float(settled)
    k = current_goal(rules, status)
    if k >= 0:
        distance = field_at(body, sight.distance[sight.goal[k]], pose[0], pose[1])
        bonus = gamma(funnels, k, t) - distance  # eq. 5 with rho = rho_max - distance
        done += min(max(0.5 + 0.5 * bonus / funnels.gamma_0[k], 0.0), 0.95)
    return min(done / goals, safe)
