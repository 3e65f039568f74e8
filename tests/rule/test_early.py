"""What is left open of a rule, met some steps early: beside the definition, worked out step by step."""

import math

import numpy as np
import pytest

from specshield.rule.early import conjunction_of, find_open, rate_open
from specshield.rule.view import rate, view_of
from specshield.shield.feasibility import prefix_of
from specshield.stl import (
    SATISFIED_ABOVE,
    Always,
    And,
    Eventually,
    Implies,
    Not,
    Or,
    Until,
    conjuncts,
    robustness,
    robustness_bounds,
)
from tests.oracles.cells import Cells

RULES = [
    "F[0,6] x > 0.5 and G[2,9] y < 0.9 and F[4,9] y > 0.3",
    "G[0,10] F[0,3] x > 0.2 and F[1,5] G[0,2] y > 0.1",
    "G[3,7] F[1,6] (x > 0.4 and F[0,5] y > 0.3)",  # a patrol of two places
    "G[0,8] (y > 0.2 -> (y < 9 U[1,5] x > 0.3))",
    "F[0,8] x > 0.4 or F[2,5] G[0,2] y > 0.3",
    "(x > -1) and F[0,8] (x > 0.4 or y > 0.6) and (y < 9 U[0,7] x > 0.3)",
    "not G[0,6] x < 0.5 and not (F[0,9] y > 1.2 or F[0,3] x > 2)",
    "F[2,7] x > 0.6",
    "G[4,9] y > 0.3 and not F[6,8] x < 0.4 and G[9,9] G[0,1] x > 0.3 and G[1,9] x > -1",
    "F[8,9] x > 0.5 and F[7,9] G[0,2] y > 0.3 and F[5,5] G[1,3] x > 0.1",  # short windows that are far away
    "(G[4,9] y > 0.3 and F[0,5] x > 0.4) or not F[2,8] x < 0.4",
    "F[0,8] (x > 0.4 and not (not F[0,6] y > 0.3)) and (F[0,8] x > 0.9 -> not (y < 9 U[0,7] y > 0.6))",
    "x > 0.5 and not y > 0.4",  # nothing is left open of it, and it has conjuncts all the same
]


def met_early(formula, start, samples, t, early, turned=0):
    """rho at a step, where what x_{0:t} has yet to show of an F or U is asked for so many steps early, and
    `turned` steps of those that are below a `not`.
    """

    def at(part, steps):
        return [met_early(part, start + k, samples, t, early, turned) for k in steps]

    def negated(part):
        return -met_early(part, start, samples, t, turned, early)

    match formula:
        case Eventually(a, b) | Until(a, b):
            last = max(b - min(early, (b - a) // 2), min(b, t - start))
            if isinstance(formula, Eventually):
                return max(at(formula.child, range(a, last + 1)))
            left, right = at(formula.left, range(last)), at(formula.right, range(last + 1))
            return max(min([right[k], *left[:k]]) for k in range(a, last + 1))
        case Always(a, b, child):
            return min(at(child, range(a, b + 1)))
        case And(children):
            return min(at(child, [0])[0] for child in children)
        case Or(children):
            return max(at(child, [0])[0] for child in children)
        case Implies(left, right):
            return max(negated(left), at(right, [0])[0])
        case Not(child):
            return negated(child)
    rho = float(robustness(formula, {name: samples[name][start : start + 1] for name in formula.names}))
    return rho if start > t else math.copysign(math.inf, rho if rho > SATISFIED_ABOVE else -1.0)


def met_far_away(part, samples, t, early):
    """rho where what an F asks for in its short window is there so many steps before, if need be."""
    sooner = min(early, (part.b - part.a) // 2)
    lead = min(early, part.b // 2) - sooner
    at = [met_early(part.child, step, samples, t, early) for step in range(part.b + 1)]
    return max(min(at[step - lead : step + 1]) for step in range(part.a, part.b - sooner + 1))


def left_open(formula, samples, t, early):
    """The least of the conjuncts that are open; a G from the first step at which its child is."""
    found = []
    for part in conjuncts(formula):
        if (
            robustness_bounds(part, {name: samples[name][: t + 1] for name in part.names})[0]
            > SATISFIED_ABOVE
        ):
            continue
        if isinstance(part, Always) and isinstance(part.child, Always):
            part = Always(part.a + part.child.a, part.b + part.child.b, part.child.child)
        if isinstance(part, Eventually) and part.a > max(t, 1) and part.b - part.a < part.a // 2:
            found.append(met_far_away(part, samples, t, early))
            continue
        if isinstance(part, Always):
            later = part.a > max(t, 1) and part.child.horizon == 0
            begins = part.a - min(early, part.a // 2) if later else min(t + 1 - part.child.horizon, part.b)
            part = Always(begins if later else max(part.a, begins), part.b, part.child)
        found.append(met_early(part, 0, samples, t, early))
    return min(found) if found else float(robustness(formula, samples))


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("early", [0, 1, 3])
def test_what_is_open_has_the_robustness_that_its_definition_says(rule, early):
    task = Cells(rule, None, {}).task
    formula, parts = conjunction_of(task, task.formula)
    view, random = view_of(task, formula), np.random.default_rng(early)
    for t in range(task.horizon):
        walk = np.abs(np.cumsum(random.normal(0.0, 0.15, (9, task.horizon + 1, 3)), axis=1))
        walk[:, : t + 1] = walk[0, : t + 1]
        prefix = prefix_of(task, formula, view, walk[0, : t + 1], {})
        rho, leaves = np.empty(9), np.empty((9, view.tree.size))
        rate(view, prefix.known, t, np.ascontiguousarray(walk[:, t + 1 :]), np.empty((1, 0)), rho, leaves)
        still, found = np.empty(len(parts.kind), np.bool_), np.empty(9)
        find_open(parts, prefix.known, t, still)
        rate_open(parts, still, t, np.full(len(still), early), leaves, found)
        samples = task.samples(walk)
        expected = [
            left_open(task.formula, {name: samples[name][n] for name in formula.names}, t, early)
            for n in range(9)
        ]
        assert found == pytest.approx(expected, abs=0)
