"""What is left open of a rule, met some steps early: beside the formula that says the same in words."""

import numpy as np
import pytest

from specshield.reasons.still_open import still_open
from specshield.rule.early import conjunction_of, find_open, rate_open
from specshield.rule.view import rate, view_of
from specshield.shield.feasibility import prefix_of
from specshield.stl import robustness
from tests.oracles.cells import Cells

RULES = [
    "F[0,6] x > 0.5 and G[2,9] y < 0.9 and F[4,9] y > 0.3",
    "G[0,10] F[0,3] x > 0.2 and F[1,5] G[0,2] y > 0.1",
    "(x > -1) and F[0,8] (x > 0.4 or y > 0.6) and (y < 9 U[0,7] x > 0.3)",
    "not G[0,6] x < 0.5 and not (F[0,9] y > 1.2 or F[0,3] x > 2)",
    "F[2,7] x > 0.6",
    "x > 0.5 and not y > 0.4",  # nothing is left open of it, and it has conjuncts all the same
]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("early", [0, 1, 3])
def test_what_is_open_has_the_robustness_of_the_formula_that_says_so(rule, early):
    task = Cells(rule, None, {}).task
    formula, parts = conjunction_of(task, task.formula)
    view, random = view_of(task, formula), np.random.default_rng(early)
    for t in range(task.horizon):
        walk = np.abs(np.cumsum(random.normal(0.0, 0.15, (9, task.horizon + 1, 3)), axis=1))
        walk[:, : t + 1], nothing = walk[0, : t + 1], np.empty((t + 1, 0))
        prefix = prefix_of(task, formula, view, walk[0, : t + 1], {})
        rho, leaves = np.empty(9), np.empty((9, view.tree.size))
        rate(view, prefix.known, t, np.ascontiguousarray(walk[:, t + 1 :]), np.empty((1, 0)), rho, leaves)
        still, found = np.empty(len(parts.kind), np.bool_), np.empty(9)
        find_open(parts, prefix.known, t, still)
        halves = (parts.b - parts.a) // 2
        rate_open(parts, still, t, np.minimum(early, halves), leaves, found)
        left = still_open(task, task.formula, walk[0, : t + 1], nothing, early)
        samples = task.samples(walk)
        assert found == pytest.approx(robustness(left, {name: samples[name] for name in left.names}), abs=0)
