"""The part of a formula that a prefix leaves open, as a formula."""

from __future__ import annotations

import numpy as np

from specshield.arrays import Floats
from specshield.caution.residual import all_of
from specshield.rule.view import look, view_of
from specshield.stl import SATISFIED_ABOVE, Always, Formula, conjuncts
from specshield.task import Task


def still_open(task: Task, formula: Formula, poses: Floats, rows: Floats) -> Formula:
    """What x_{0:t} leaves open of the formula; the formula itself where nothing is open.

    poses [t + 1, 3], rows [t + 1, S]: the signals. A G is asked from the first step on at which its child is
    open.
    """
    t, kept = len(poses) - 1, list[Formula]()
    for conjunct in conjuncts(formula):
        if bounds_after(task, conjunct, poses, rows)[0] > SATISFIED_ABOVE:
            continue
        match conjunct:
            case Always(a, b, child):
                kept.append(Always(max(a, min(t + 1 - child.horizon, b)), b, child))
            case _:
                kept.append(conjunct)
    return all_of(kept) if kept else formula


def bounds_after(task: Task, formula: Formula, poses: Floats, rows: Floats) -> tuple[float, float]:
    """Bounds (lo, hi) on rho of the formula, or of a part of it, after x_{0:t}."""
    view = view_of(task, formula)
    low, high = look(view, poses, rows, np.empty(view.value.tree.size))
    return float(low), float(high)
