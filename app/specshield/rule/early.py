"""What a prefix leaves open of a formula, with each F of the conjunction met some steps early.

What the prefix has settled is left out. An F is asked for so many steps before its window ends, a G from the
first step on at which its child is open: read off the leaves' values, so no formula is compiled at a step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints, copy_row
from specshield.compiled import kernel, leaf
from specshield.rule.residual import joined
from specshield.rule.values import places
from specshield.stl import SATISFIED_ABOVE, Always, Eventually, Formula, Or, Until, conjuncts
from specshield.stl.tree import Tree, compile_tree, is_temporal, tree_value
from specshield.task import Task, kept_with_task

OTHER, EVENTUALLY, ALWAYS = 0, 1, 2


class Conjuncts(NamedTuple):
    """A conjunction of K formulas, over the leaves of its tree.

    below: the tree without the F or G at the top of each conjunct, and the `and`. kind [K]: what that is;
    OTHER: none, all is in `below`. at [K]: where in the buffer values begin that it ranges over. a, b [K]:
    its window. horizon [K]: of what is below. plain [K]: whether that is a predicate, or under F a G of one.
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
    """The formula itself where it is a plain conjunction, else one that is equal; and its conjuncts."""
    above, slots = conjuncts(formula) if is_temporal(formula) else (formula,), places(task)  # as in the tree
    parts = [each for part in above for each in _with_deadline(part)]
    whole = formula if joined(parts) == formula else joined(parts)
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
        kept[node : node + (k > 0)] = False  # the `and`
        node, size = node + (k > 0), size + own.size
    below = tree._replace(**{name: getattr(tree, name)[kept] for name in tree._fields[:6]})  # of its nodes
    kind_of, at, a, b, horizon = np.array(rows, np.int64).T.copy()
    return whole, Conjuncts(below, kind_of, at, a, b, horizon, np.array([*map(_is_plain, parts)], np.bool_))


def _with_deadline(part: Formula) -> tuple[Formula, ...]:
    """A conjunct, and for an `until`, or an `or` of F, the F that follows from it, which can be met early."""
    if isinstance(part, Until):
        return part, Eventually(part.a, part.b, part.right)
    ways = [each for each in part.parts if isinstance(each, Eventually)]
    if not isinstance(part, Or) or len(ways) < len(part.children):
        return (part,)
    return part, Eventually(min(w.a for w in ways), max(w.b for w in ways), Or(tuple(w.child for w in ways)))


def _is_plain(part: Formula) -> bool:
    inner = part.child if isinstance(part, Eventually) and isinstance(part.child, Always) else part
    return isinstance(inner, (Always, Eventually)) and inner.child.horizon == 0


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
