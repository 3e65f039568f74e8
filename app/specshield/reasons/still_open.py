"""What a prefix leaves open of a formula, as a formula."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from specshield.arrays import Floats
from specshield.rule.residual import joined
from specshield.rule.view import look, view_of
from specshield.stl import SATISFIED_ABOVE, Always, Eventually, Formula, Until, conjuncts
from specshield.task import Task


def still_open(task: Task, formula: Formula, poses: Floats, rows: Floats, slack: int) -> Formula:
    """What x_{0:t} leaves open of the formula, with each F and U of the conjunction met `slack` steps early.

    poses [t + 1, 3], rows [t + 1, S]: the signals. A G is asked from the first step on at which its child is
    open. A window keeps half its length or more. Where nothing is open the result is the formula itself.
    """
    t, kept = len(poses) - 1, list[Formula]()
    for conjunct in conjuncts(formula):
        if bounds_after(task, conjunct, poses, rows)[0] > SATISFIED_ABOVE:
            continue
        match conjunct:
            case Always(a, b, child):
                kept.append(Always(max(a, min(t + 1 - child.horizon, b)), b, child))
            case Eventually(a, b) | Until(a, b):
                kept.append(replace(conjunct, b=b - min(slack, (b - a) // 2)))
            case _:
                kept.append(conjunct)
    return joined(kept) if kept else formula


def bounds_after(task: Task, formula: Formula, poses: Floats, rows: Floats) -> tuple[float, float]:
    """Bounds (lo, hi) on rho of the formula, or of a part of it, after x_{0:t}."""
    view = view_of(task, formula)
    low, high = look(view, poses, rows, np.empty(view.tree.size))
    return float(low), float(high)
