"""What a prefix leaves of a formula: what is still open, and what can still be kept of a violated one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from specshield.arrays import Floats
from specshield.rule.view import look, view_of
from specshield.stl import SATISFIED_ABOVE, Always, And, Eventually, Formula, conjuncts, robustness_bounds
from specshield.task import Task


def left_over(formula: Formula, prefix: Mapping[str, Floats], t: int) -> tuple[list[Formula], list[Always]]:
    """The conjuncts that can still be kept, and the broken ones of the form G whose windows are not over."""
    kept: list[Formula] = []
    broken: list[Always] = []
    for conjunct in conjuncts(formula):
        _, high = robustness_bounds(conjunct, {name: prefix[name] for name in conjunct.names})
        if high > SATISFIED_ABOVE:
            kept.append(conjunct)
        elif isinstance(conjunct, Always) and conjunct.b > t:
            broken.append(conjunct)
    return kept, broken


def again(broken: Sequence[Always], t: int) -> list[Formula]:
    """Those of the broken G whose windows reach step t, each enforced from step t on."""
    return [Always(max(each.a, t), each.b, each.child) for each in broken if each.b >= t]


def still_open(task: Task, formula: Formula, poses: Floats, rows: Floats, slack: int) -> Formula:
    """What x_{0:t} leaves open of the formula, with each F of the conjunction met `slack` steps early.

    poses [t + 1, 3], rows [t + 1, S]: the signals. A G is asked from the first step on at which its child is
    still open. The window of an F keeps at least half its length, however much slack is asked for. Where
    nothing is open the result is the formula itself.
    """
    t, kept = len(poses) - 1, list[Formula]()
    for conjunct in conjuncts(formula):
        if bounds_after(task, conjunct, poses, rows)[0] > SATISFIED_ABOVE:
            continue
        match conjunct:
            case Always(a, b, child):
                kept.append(Always(max(a, min(t + 1 - child.horizon, b)), b, child))
            case Eventually(a, b, child):
                kept.append(Eventually(a, b - min(slack, (b - a) // 2), child))
            case _:
                kept.append(conjunct)
    return joined(kept) if kept else formula


def bounds_after(task: Task, formula: Formula, poses: Floats, rows: Floats) -> tuple[float, float]:
    """Bounds (lo, hi) on rho of the formula, or of a part of it, after x_{0:t}."""
    view = view_of(task, formula)
    low, high = look(view, poses, rows, np.empty(view.tree.size))
    return float(low), float(high)


def joined(parts: Sequence[Formula]) -> Formula:
    return parts[0] if len(parts) == 1 else And(tuple(parts))
