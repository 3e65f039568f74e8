"""Funnel-shaped rewards (paper, section IV-A, after Saxena, Gorantla and Jagtap, 2024).

    gamma(t) = (gamma_0 - gamma_inf) exp(-l t) + gamma_inf                      (eq. 4)
    r(x_t)   = rho(x_t, predicate) + gamma(t) - rho_max                         (eq. 5)

There are two rewards for a conjunction of obligations.

`paper` is eq. 5 with Table I to the letter: t is the episode's step, robustness that of the formula. The
paper leaves some things open, which are chosen as follows. gamma_inf is REST of its upper limit. t* of F is
the middle of its window, that of F G the middle of Table I's interval. A t* of 0, as for G[0,b], is replaced
by 1, the first step that there is. r is the least over all obligations whose window holds t, 0 if there are
none. An episode ends at the horizon, or when an obligation is broken.

`progress`, the default, is ours: it counts the goals that are settled, adds the current goal's funnel along
free space, whose clock starts with the goal's window, and takes the minimum with the robustness of each
`always`, capped. Uncapped, the farthest distance from a forbidden region would rule that minimum.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Ints
from specshield.compiled import leaf
from specshield.policy.dqn.observation import State
from specshield.policy.dqn.scene import Scene, current_goal, distance_to
from specshield.policy.progress import ALWAYS, EVENTUALLY_ALWAYS, PENDING, SETTLED, Rules

# Chosen by hand; nothing was measured.
CAP = 0.15  # [m] robustness of an `always` beyond which more is no better, and rho_max inside a goal
REST = 0.5  # gamma_inf as a share of its upper limit min(gamma_0, rho_max) of Table I
FAR_SHARE = 99  # [%] of the map's cells that are nearer to a goal than the reach of its funnel
MOST_OF_A_GOAL = 0.95  # what being close to a goal counts at most; 1 is for a goal that is settled


class Funnels(NamedTuple):
    """One funnel for each obligation: eq. 4's parameters and the step at which its clock starts, each [K].

    literal: of the reward `paper`, in which every clock starts at 0.
    """

    gamma_0: Floats
    gamma_inf: Floats
    rate: Floats
    clock: Ints
    rho_max: Floats
    literal: bool


def decay_rate(gamma_0: float, gamma_inf: float, rho_max: float, t_star: float) -> float:
    """Table I's l: the funnel's boundary reaches zero robustness at t_star steps.

    t_star counts as at least 1, since G[0,b] would divide by zero. l is at least 0: the logarithm is negative
    where the predicate holds everywhere, and there the funnel would widen without end.
    """
    return max(math.log((gamma_0 - gamma_inf) / (rho_max - gamma_inf)) / max(t_star, 1.0), 0.0)


def make_funnels(scene: Scene, lowest: Floats, highest: Floats, literal: bool) -> Funnels:
    """The funnels of a task's obligations. lowest, highest (K,): each predicate's robustness over free space.

    literal: for the reward `paper`. t* is Table I's: the window's start for G, the middle of the window in
    which the predicate has to begin to hold for the others.
    """
    rules, n = scene.rules, len(scene.rules.kind)
    gamma_0, gamma_inf, rate, rho_max = (np.zeros(n) for _ in range(4))
    clock = np.zeros(n, dtype=np.int64)
    for k in range(n):
        if literal or rules.kind[k] == ALWAYS:
            top, span = max(float(highest[k]), 1e-3), max(float(highest[k] - lowest[k]), 2e-3)
        else:  # along free space, robustness is minus the distance, and CAP inside the goal
            reach = float(np.percentile(scene.distance[scene.goal[k]], FAR_SHARE))
            top, span = CAP, reach + CAP
        gamma_0[k], rho_max[k] = span, top
        gamma_inf[k] = REST * min(span, top)
        opens = rules.a[k] + rules.c2[k]
        end = rules.c1[k] if rules.kind[k] == EVENTUALLY_ALWAYS else rules.b[k]
        width = 0 if rules.kind[k] == ALWAYS else end - rules.a[k]
        clock[k] = 0 if literal else opens
        t_star = float(opens - clock[k]) + 0.5 * float(width)
        rate[k] = decay_rate(gamma_0[k], gamma_inf[k], rho_max[k], t_star)
    return Funnels(gamma_0, gamma_inf, rate, clock, rho_max, literal)


@leaf
def gamma(funnels: Funnels, k: int, t: int) -> float:
    """Eq. 4 at step t; gamma_0 before the clock starts."""
    elapsed = max(t - funnels.clock[k], 0)
    decayed = (funnels.gamma_0[k] - funnels.gamma_inf[k]) * math.exp(-funnels.rate[k] * elapsed)
    return float(decayed + funnels.gamma_inf[k])


@leaf
def reward(scene: Scene, funnels: Funnels, t: int, state: State) -> float:
    """The reward of having come to x_t, with its progress and predicates in `state`."""
    if funnels.literal:
        return _paper_reward(scene.rules, funnels, t, state)
    rules, status = scene.rules, state.status
    goals, settled, safe = 0, 0, 1.0
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == ALWAYS:
            if status[k] == PENDING and t >= rules.a[k]:
                safe = min(safe, state.predicates[k] / CAP)
        else:
            goals += 1
            settled += status[k] == SETTLED
    if goals == 0:
        return safe
    done = float(settled)
    k = current_goal(rules, status)
    if k >= 0:
        bonus = gamma(funnels, k, t) - distance_to(scene, k, state.pose[0], state.pose[1])  # eq. 5
        done += min(max(0.5 + 0.5 * bonus / funnels.gamma_0[k], 0.0), MOST_OF_A_GOAL)
    return min(done / goals, safe)


@leaf
def _paper_reward(rules: Rules, funnels: Funnels, t: int, state: State) -> float:
    """The minimum of eq. 5 over the obligations whose window holds t, 0 where none does."""
    least = np.inf
    for k in range(rules.kind.shape[0]):
        if rules.a[k] <= t <= rules.last[k]:
            least = min(least, state.predicates[k] + gamma(funnels, k, t) - funnels.rho_max[k])
    return least if least < np.inf else 0.0
