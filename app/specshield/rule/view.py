"""What a formula reads along trajectories, and its robustness on them, compiled: one kernel a question."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints, copy_row
from specshield.compiled import Boxed, box, inlined, kernel
from specshield.rule.values import REGIONS, fill_pose, fill_region, places, regions_of
from specshield.stl import Always, And, Formula, Node, Until
from specshield.stl.conjunction import is_predicate
from specshield.stl.program import STACK_SIZE, VALUE, evaluate_packed
from specshield.stl.tree import Tree, bounds_at, compile_tree, tree_value
from specshield.task import Task, kept_with_task
from specshield.world.regions import PackedRegions, turns_with_robot


class View(NamedTuple):
    """A formula over a task with R regions and S signals. Its l leaves read `values` (rule/values.py).

    first, last [R]: the steps between which some leaf reads a region. binds [l]: whether each value of a leaf
    is an upper bound on rho, as under the G of a conjunction.
    """

    tree: Tree
    regions: PackedRegions
    first: Ints
    last: Ints
    binds: Bools


@kept_with_task
def view_of(task: Task, formula: Formula, ahead: bool = False) -> Boxed[View]:
    """The formula, or a part of it, prepared once. ahead: see `compile_tree`; no leaf binds then."""
    names = list(task.areas)
    tree = compile_tree(formula, places(task), ahead)
    first, last = np.full(len(names), np.iinfo(np.int64).max), np.full(len(names), -1)
    programs = tree.programs
    for n in range(len(tree.leaf_at)):
        code = slice(programs.starts[n], programs.starts[n + 1])
        for place in programs.args[code][programs.ops[code] == VALUE]:
            r = int(place) - REGIONS
            if 0 <= r < len(names):
                first[r], last[r] = min(first[r], tree.leaf_start[n]), max(last[r], tree.leaf_stop[n] - 1)
    binds = np.array(list(_binding(formula, not ahead)), np.bool_)
    return box(View(tree, regions_of(task), first, last, binds))


def _binding(formula: Node, binds: bool) -> Iterator[bool]:
    """`View.binds`, in the order of the tree's leaves."""
    if is_predicate(formula):
        yield binds
        return
    right_alone = isinstance(formula, Until) and formula.b == 0  # as in stl/tree.py
    for part in formula.parts[right_alone:]:
        yield from _binding(part, binds and isinstance(formula, (And, Always)))


@inlined
def value_count(view: View, signals: Floats) -> int:
    """How long `values` is. signals (m, S)."""
    return int(REGIONS + view.first.shape[0] + signals.shape[1])


@inlined
def read_step(
    view: View,
    poses: Floats,
    signals: Floats,
    start: int,
    k: int,
    values: Floats,
    stack: Floats,
    buffer: Floats,
) -> float:
    """Writes the leaves at step start + k, at poses[k], into `buffer`. What is unchanged is not read again.

    poses (n, 3): the first is at step `start`; signals (m, S): at the same steps, the last row is held.
    Returns the least value of the leaves that bind, inf if none does, NaN if some leaf is not a number.
    values (`value_count`,), stack: scratch, to be left as they are between the steps.
    """
    tree, regions, held = view.tree, view.first.shape[0], signals.shape[0] - 1
    t, x, y, theta = start + k, poses[k, 0], poses[k, 1], poses[k, 2]
    placed = k > 0 and x == poses[k - 1, 0] and y == poses[k - 1, 1]
    still = placed and theta == poses[k - 1, 2]
    same = still and k > held
    if not same:
        fill_pose(x, y, theta, values)
        for s in range(signals.shape[1]):
            values[REGIONS + regions + s] = signals[min(k, held), s]
    for r in range(regions):
        if t < view.first[r] or t > view.last[r]:
            continue
        known = t > view.first[r] and (still or (placed and not turns_with_robot(view.regions, r)))
        if not known:
            fill_region(view.regions, r, values)
    least = np.inf
    for n in range(tree.leaf_at.shape[0]):
        if tree.leaf_start[n] <= t < tree.leaf_stop[n]:
            i = tree.leaf_at[n] + t - tree.leaf_start[n]
            if same and t > tree.leaf_start[n]:
                buffer[i] = buffer[i - 1]
            else:
                buffer[i] = evaluate_packed(n, tree.programs, values, stack)
            if math.isnan(buffer[i]):
                return math.nan
            if view.binds[n] and buffer[i] < least:
                least = buffer[i]
    return least


@inlined
def _read(
    view: View, poses: Floats, signals: Floats, start: int, values: Floats, stack: Floats, buffer: Floats
) -> bool:
    """`read_step` for all poses (n, 3); returns False if some leaf is not a number."""
    for k in range(poses.shape[0]):
        if math.isnan(read_step(view, poses, signals, start, k, values, stack, buffer)):
            return False
    return True


@kernel
def look(boxed: Boxed[View], poses: Floats, signals: Floats, known: Floats) -> tuple[float, float]:
    """Bounds (lo, hi) on rho after x_{0:t}; NaN where the formula's arithmetic is not finite on it.

    poses (t + 1, 3), signals (t + 1, S). known (tree.size,): the leaves at the steps to t are written there.
    """
    view = boxed.value
    values = np.empty(value_count(view, signals))
    if not _read(view, poses, signals, 0, values, np.empty(STACK_SIZE), known):
        return math.nan, math.nan
    return bounds_at(view.tree, poses.shape[0] - 1, known.copy(), known.copy())


@inlined
def recall_prefix(view: View, known: Floats, t: int, buffer: Floats) -> None:
    """Writes the leaves at the steps to t, which `look` left in `known`, into `buffer`."""
    tree = view.tree
    for n in range(tree.leaf_at.shape[0]):
        at = tree.leaf_at[n]
        for i in range(at, at + min(t + 1, tree.leaf_stop[n]) - tree.leaf_start[n]):
            buffer[i] = known[i]


@kernel
def rate(
    boxed: Boxed[View], known: Floats, t: int, poses: Floats, held: Floats, rho: Floats, leaves: Floats
) -> None:
    """rho (N,) of the futures poses (N, T - t, 3) of the prefix that `look` left in `known`; NaN as there.

    held (1, S): the values that the signals keep from step t + 1 on. leaves (N, tree.size) are written.
    """
    view = boxed.value
    tree, values = view.tree, np.empty(value_count(view, held))
    stack, buffer = np.empty(STACK_SIZE), np.empty(tree.size)
    for f in range(poses.shape[0]):
        recall_prefix(view, known, t, buffer)
        sound = _read(view, poses[f], held, t + 1, values, stack, buffer)
        copy_row(buffer, leaves[f])
        rho[f] = tree_value(tree, buffer) if sound else math.nan
