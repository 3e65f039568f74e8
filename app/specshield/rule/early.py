"""What a prefix leaves open of a formula, with each F of the conjunction met some steps early.

A conjunct that the prefix has settled is left out. An F is asked for so many steps before its window ends, a
G from the first step on at which its child is still open. All of it is read off the values of the formula's
leaves along a trajectory, so that no formula is compiled at a step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints, copy_row
from specshield.compiled import kernel, leaf
from specshield.rule.values import places
from specshield.stl import SATISFIED_ABOVE, Always, And, Eventually, Formula, conjuncts
from specshield.stl.tree import Tree, compile_tree, is_temporal, tree_value
from specshield.task import Task, kept_with_task

OTHER, EVENTUALLY, ALWAYS = 0, 1, 2


class Conjuncts(NamedTuple):
    """A conjunction of K formulas, over the leaves of its tree.

    below: the tree without the F or G at the top of each conjunct, and without the `and` that joins them.
    kind [K]: what that is; OTHER: none, and the conjunct is whole in `below`. at [K]: where in the buffer the
    values begin that it ranges over; a, b [K]: its window; horizon [K]: of what is below it. plain [K]:
    whether that is a predicate, or under an F a G over one.
    """

    below: Tree
    kind: Ints
    at: Ints
    a: Ints
    b: Ints
    horizon: Ints
    plain: Bools


@kept_with_task
def conjunction_of(task: Task, formula: Formula) -> tuple[Formula, Conjuncts]:
    """The formula as a plain conjunction, whose tree has the leaves, and its conjuncts, prepared once.

    It is the very formula where that is one.
    """
    parts, slots = conjuncts(formula) if is_temporal(formula) else (formula,), places(task)  # as in the tree
    whole = parts[0] if len(parts) == 1 else And(parts)
    whole = formula if whole == formula else whole
    tree = compile_tree(whole, slots)
    rows, kept, node, size = [], np.ones(len(tree.op), np.bool_), 0, 0
    for k, part in enumerate(parts):
        own = compile_tree(part, slots)
        node += len(own.op)
        row = (OTHER, size, 0, 0, 0)
        if isinstance(part, (Always, Eventually)):
            kept[node - 1] = False
            kind = EVENTUALLY if isinstance(part, Eventually) else ALWAYS
            row = (kind, size, part.a, part.b, part.child.horizon)
        rows.append(row)
        if k > 0:  # the `and`
            kept[node] = False
            node += 1
        size += own.size
    below = tree._replace(
        **{name: getattr(tree, name)[kept] for name in ("op", "at", "length", "a", "b", "right")}
    )
    kind_of, at, a, b, horizon = np.array(rows, np.int64).T.copy()
    plain = np.array([_is_plain(part) for part in parts], np.bool_)
    return whole, Conjuncts(below, kind_of, at, a, b, horizon, plain)


def _is_plain(part: Formula) -> bool:
    if isinstance(part, Eventually) and isinstance(part.child, Always):
        return part.child.child.horizon == 0
    return isinstance(part, (Always, Eventually)) and part.child.horizon == 0


@kernel
def find_open(parts: Conjuncts, known: Floats, t: int, still: Bools) -> None:
    """Writes which conjuncts x_{0:t} has not settled into still (K,). known (size,): the leaves to step t."""
    tree, low = parts.below, known.copy()
    for n in range(tree.leaf_at.shape[0]):
        for step in range(max(t + 1, tree.leaf_start[n]), tree.leaf_stop[n]):
            low[tree.leaf_at[n] + step - tree.leaf_start[n]] = tree.low[n]
    tree_value(tree, low)
    for k in range(still.shape[0]):
        still[k] = not _value(parts, k, parts.a[k], parts.b[k], low) > SATISFIED_ABOVE


@kernel
def rate_open(parts: Conjuncts, still: Bools, t: int, early: Ints, leaves: Floats, rho: Floats) -> None:
    """rho (N,) of the conjuncts that are `still` (K,) open, each F met early (K,) steps before its end.

    leaves (N, size): the leaves along N trajectories. Where nothing is open, rho is that of the whole.
    """
    buffer, some = np.empty(leaves.shape[1]), still.any()
    for f in range(leaves.shape[0]):
        copy_row(leaves[f], buffer)
        tree_value(parts.below, buffer)
        least = np.inf
        for k in range(still.shape[0]):
            a, b = parts.a[k], parts.b[k]
            if some and parts.kind[k] == EVENTUALLY:
                b -= early[k]
            elif some and parts.kind[k] == ALWAYS:
                a = max(a, min(t + 1 - parts.horizon[k], b))
            if still[k] or not some:
                least = min(least, _value(parts, k, a, b, buffer))
        rho[f] = least


@leaf
def _value(parts: Conjuncts, k: int, a: int, b: int, buffer: Floats) -> float:
    """rho of conjunct k, with the window [a, b] for its own, from what is below it."""
    first = parts.at[k] - parts.a[k]
    value = buffer[first + a]
    for i in range(first + a + 1, first + b + 1):
        value = max(value, buffer[i]) if parts.kind[k] == EVENTUALLY else min(value, buffer[i])
    return float(value + 0.0)
