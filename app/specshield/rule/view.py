"""What a formula reads along trajectories, and its robustness on them, compiled: one kernel a question."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import inlined, kernel
from specshield.rule.values import REGIONS, fill_pose, fill_region, places, regions_of
from specshield.stl import Formula
from specshield.stl.program import STACK_SIZE, VALUE, evaluate_packed
from specshield.stl.tree import Tree, compile_tree, tree_bounds, tree_value
from specshield.task import Task
from specshield.world.regions import PackedRegions

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class View(NamedTuple):
    """A formula over a task with R regions and S signals. Its leaves read `values` (rule/values.py).

    first, last [R]: the steps between which some leaf reads a region.
    """

    tree: Tree
    regions: PackedRegions
    first: Ints
    last: Ints


@lru_cache(maxsize=256)
def view_of(task: Task, formula: Formula) -> View:
    """The formula, or a part of it, prepared once."""
    names = list(task.regions)
    tree = compile_tree(formula, places(task))
    first, last = np.full(len(names), np.iinfo(np.int64).max), np.full(len(names), -1)
    programs = tree.programs
    for n in range(len(tree.leaf_at)):
        code = slice(programs.starts[n], programs.starts[n + 1])
        for place in programs.args[code][programs.ops[code] == VALUE]:
            r = int(place) - REGIONS
            if 0 <= r < len(names):
                first[r], last[r] = min(first[r], tree.leaf_start[n]), max(last[r], tree.leaf_stop[n] - 1)
    return View(tree, regions_of(task), first, last)


@inlined
def _read(
    view: View, poses: Floats, signals: Floats, start: int, values: Floats, stack: Floats, buffer: Floats
) -> bool:
    """The leaves at the steps from `start` on, poses (n, 3), into `buffer`; False where one is no number.

    signals (m, S): of the same steps, the last held. values (3 + R + S,), stack: scratch.
    """
    tree, first_signal = view.tree, REGIONS + view.first.shape[0]
    regions, leaves, held = view.first.shape[0], tree.leaf_at.shape[0], signals.shape[0] - 1
    sound = True
    for k in range(poses.shape[0]):
        t, x, y, theta = start + k, poses[k, 0], poses[k, 1], poses[k, 2]
        placed = k > 0 and x == poses[k - 1, 0] and y == poses[k - 1, 1]
        same = placed and theta == poses[k - 1, 2] and k > held
        if not same:
            fill_pose(x, y, theta, values)
            for s in range(signals.shape[1]):
                values[first_signal + s] = signals[min(k, held), s]
        for r in range(regions):
            if view.first[r] <= t <= view.last[r] and not (placed and t > view.first[r]):
                fill_region(view.regions, r, x, y, values)
        for n in range(leaves):
            if tree.leaf_start[n] <= t < tree.leaf_stop[n]:
                i = tree.leaf_at[n] + t - tree.leaf_start[n]
                if same and t > tree.leaf_start[n]:
                    buffer[i] = buffer[i - 1]
                else:
                    buffer[i] = evaluate_packed(n, tree.programs, values, stack)
                    sound = sound and not math.isnan(buffer[i])
    return sound


@kernel
def look(view: View, poses: Floats, signals: Floats, known: Floats) -> tuple[float, float]:
    """Bounds (lo, hi) on rho after x_{0:t}; NaN where the formula's arithmetic is not finite on it.

    poses (t + 1, 3), signals (t + 1, S). known (tree.size,): the leaves at the steps to t are written there.
    """
    tree, stop = view.tree, poses.shape[0]
    values = np.empty(REGIONS + view.first.shape[0] + signals.shape[1])
    if not _read(view, poses, signals, 0, values, np.empty(STACK_SIZE), known):
        return math.nan, math.nan
    low, high = known.copy(), known.copy()
    for n in range(tree.leaf_at.shape[0]):
        at = tree.leaf_at[n] - tree.leaf_start[n]
        for t in range(max(stop, tree.leaf_start[n]), tree.leaf_stop[n]):
            low[at + t], high[at + t] = tree.low[n], tree.high[n]
    return tree_bounds(tree, low, high)


@kernel
def rate(view: View, known: Floats, t: int, poses: Floats, held: Floats, rho: Floats) -> None:
    """rho (N,) of the futures poses (N, T - t, 3) of the prefix that `look` left in `known`; NaN as there.

    held (1, S): the values that the signals keep from step t + 1 on.
    """
    tree = view.tree
    values = np.empty(REGIONS + view.first.shape[0] + held.shape[1])
    stack, buffer = np.empty(STACK_SIZE), np.empty(tree.size)
    for f in range(poses.shape[0]):
        for n in range(tree.leaf_at.shape[0]):
            at = tree.leaf_at[n]
            for i in range(at, at + min(t + 1, tree.leaf_stop[n]) - tree.leaf_start[n]):
                buffer[i] = known[i]
        sound = _read(view, poses[f], held, t + 1, values, stack, buffer)
        rho[f] = tree_value(tree, buffer) if sound else math.nan


@kernel
def best_rows(motions: Ints, rho: Floats, rows: Ints) -> None:
    """The row of the most robust future for each motion, rows (M,); the lowest on ties, -1 where it has none.

    motions (N, T - t): the futures', rho (N,).
    """
    rows[:] = -1
    for f in range(motions.shape[0]):
        m = motions[f, 0]
        if rows[m] < 0 or rho[f] > rho[rows[m]]:
            rows[m] = f
