"""Whole formulas as flat trees for compiled code: one pass over a buffer, and nothing is allocated.

A tree's value equals `robustness(formula, ...)` bit for bit, and its bounds equal `robustness_bounds`: both
are minima and maxima of the same float64 numbers. The leaves are the largest parts without a temporal
operator, as `Program`s. A node's values, rho at consecutive steps, replace those of its first operand.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.compiled import inlined, leaf
from specshield.stl.conjunction import is_predicate
from specshield.stl.formula import Always, And, Eventually, Formula, Implies, Not, Or, Until
from specshield.stl.program import Programs, compile_predicates
from specshield.stl.robustness import unseen_bounds
from specshield.stl.terms import may_fail

NOT, AND, OR, ALWAYS, EVENTUALLY, UNTIL = range(6)


class Tree(NamedTuple):
    """A formula at step 0, of n nodes in postfix order and l leaves. rho ends up at buffer[0].

    op [n]: the operator. at, right [n]: where in the buffer the values of its first and second operand begin;
    for F and G, where those of its only operand begin, and where those in the window of its first step do.
    length [n]: how many values it has, which are written from `at` on. a, b [n]: its window, in steps. start
    [n]: the step of its first value. turned [n]: whether it stands below an odd number of `not`.

    leaf_at [l]: where a leaf's values begin in the buffer. leaf_start, leaf_stop [l]: the steps of its
    values, `leaf_stop` excluded. sought [l]: 1 if, once `not` is moved inwards, an F or the right side of an
    U asks the leaf to be true; else 0. low, high [l]: bounds on its value at a step still to come. size: of
    the buffer.
    """

    op: Ints
    at: Ints
    length: Ints
    a: Ints
    b: Ints
    right: Ints
    start: Ints
    turned: Bools
    leaf_at: Ints
    leaf_start: Ints
    leaf_stop: Ints
    sought: Ints
    low: Floats
    high: Floats
    programs: Programs
    size: int


def compile_tree(formula: Formula, slots: Mapping[str, int], ahead: bool = False) -> Tree:
    """The tree of `formula`, whose leaves find a name's value at values[slots[name]].

    ahead: whether the operand of an F or G that `is_far` has values before the window too, from the step of
    the F or G on. Raises FormulaError for a name without a slot.
    """
    builder = _Builder(ahead)
    builder.add(formula, 0, 1, False)
    *nodes, turned = np.array(builder.nodes, np.int64).reshape(-1, 8).T.copy()
    leaves = np.array(builder.leaves, np.int64).T.copy()
    bounds = np.array([unseen_bounds(each) for each in builder.predicates]).T.copy()
    programs = compile_predicates(builder.predicates, slots)
    return Tree._make((*nodes, turned.astype(np.bool_), *leaves, *bounds, programs, builder.size))


def is_far(formula: Always | Eventually, turned: bool) -> bool:
    """Whether an F or G can only be met some steps early by what holds before its window, and can be so.

    So it is if half of the time until the window is longer than the window of an F, or than the horizon of a
    G's child. turned: whether the formula stands below an odd number of `not`: then F and G change places.
    """
    seeks = isinstance(formula, Eventually) is not turned
    span = formula.b - formula.a if seeks else formula.child.horizon
    return span < formula.a // 2 and not may_fail(formula.child)


class _Builder:
    def __init__(self, ahead: bool) -> None:
        self.ahead = ahead
        self.nodes: list[tuple[int, ...]] = []
        self.leaves: list[tuple[int, int, int, int]] = []
        self.predicates: list[Formula] = []
        self.size = 0

    def add(self, formula: Formula, start: int, stop: int, turned: bool, sought: bool = False) -> int:
        """Adds the nodes for rho at steps start to stop - 1; returns where in the buffer these begin. turned,
        sought: see `Tree`.
        """

        def node(op: int, at: int, right: int = -1, a: int = 0, b: int = 0) -> int:
            self.nodes.append((op, at, stop - start, a, b, right, start, turned))
            return at

        match formula:
            case _ if is_predicate(formula):
                at, self.size = self.size, self.size + stop - start
                self.leaves.append((at, start, stop, sought and not turned))
                self.predicates.append(formula)
                return at
            case Not(child):
                return node(NOT, self.add(child, start, stop, not turned, sought))
            case And(children) | Or(children):
                op = AND if isinstance(formula, And) else OR
                at = self.add(children[0], start, stop, turned, sought)
                for child in children[1:]:
                    node(op, at, self.add(child, start, stop, turned, sought))
                return at
            case Implies(left, right):
                at = node(NOT, self.add(left, start, stop, not turned, sought))
                return node(OR, at, self.add(right, start, stop, turned, sought))
            case Always(a, b, child) | Eventually(a, b, child):
                op = ALWAYS if isinstance(formula, Always) else EVENTUALLY
                before = a if self.ahead and is_far(formula, turned) else 0
                at = self.add(child, start + a - before, stop + b, turned, (op == EVENTUALLY) is not turned)
                return node(op, at, at + before, a, b)
            case Until(_, 0, _, right):
                return self.add(right, start, stop, turned, not turned)
            case Until(a, b, left, right):
                at = self.add(left, start, stop - 1 + b, turned)
                return node(UNTIL, at, self.add(right, start + a, stop + b, turned, not turned), a, b)
        raise TypeError(f"not a formula: {formula!r}")


@inlined
def tree_value(tree: Tree, buffer: Floats) -> float:
    """rho from the leaves' values in `buffer` (size,), which is overwritten."""
    for n in range(tree.op.shape[0]):
        apply(tree, n, buffer)
    return float(buffer[0] + 0.0)  # -0.0 becomes 0.0, as in `robustness`


@leaf
def bounds_at(tree: Tree, t: int, low: Floats, high: Floats) -> tuple[float, float]:
    """(lo, hi) of rho after x_{0:t}. low, high (size,): the leaves to step t; both are overwritten."""
    for n in range(tree.leaf_at.shape[0]):
        at = tree.leaf_at[n] - tree.leaf_start[n]
        for step in range(max(t + 1, tree.leaf_start[n]), tree.leaf_stop[n]):
            low[at + step], high[at + step] = tree.low[n], tree.high[n]
    return tree_bounds(tree, low, high)


@leaf
def tree_bounds(tree: Tree, low: Floats, high: Floats) -> tuple[float, float]:
    """(lo, hi) of rho from the leaves' lower and upper values; both buffers (size,) are overwritten."""
    for n in range(tree.op.shape[0]):
        if tree.op[n] == NOT:
            for i in range(tree.at[n], tree.at[n] + tree.length[n]):
                low[i], high[i] = -high[i], -low[i]
        else:
            apply(tree, n, low)  # monotone
            apply(tree, n, high)
    return float(low[0] + 0.0), float(high[0] + 0.0)


@inlined
def apply(tree: Tree, n: int, buffer: Floats) -> None:
    """Applies node n in place: no value is written before its last use."""
    op, at, count, right = tree.op[n], tree.at[n], tree.length[n], tree.right[n]
    if op == NOT:
        for i in range(at, at + count):
            buffer[i] = -buffer[i]
    elif op == AND:
        for i in range(count):
            buffer[at + i] = min(buffer[at + i], buffer[right + i])
    elif op == OR:
        for i in range(count):
            buffer[at + i] = max(buffer[at + i], buffer[right + i])
    elif op == UNTIL:
        for i in range(count):
            buffer[at + i] = until(buffer, at + i, right + i, tree.a[n], tree.b[n])
    else:
        slide(buffer, at, right, count, tree.b[n] - tree.a[n] + 1, op == ALWAYS)


@inlined
def slide(buffer: Floats, at: int, right: int, count: int, width: int, least: bool) -> None:
    """The extremum of every `width` neighbours from `right` on, in log2(width) passes, as
    `robustness._sliding`.
    """
    for i in range(count + width - 1 if right > at else 0):
        buffer[at + i] = buffer[right + i]
    if count == 1:
        best = buffer[at]
        for i in range(at + 1, at + width):
            best = min(best, buffer[i]) if least else max(best, buffer[i])
        buffer[at] = best
        return
    size, length = 1, count + width - 1
    while 2 * size <= width:
        length -= size
        for i in range(at, at + length):
            buffer[i] = min(buffer[i], buffer[i + size]) if least else max(buffer[i], buffer[i + size])
        size *= 2
    for i in range(at, at + count):
        j = i + width - size
        buffer[i] = min(buffer[i], buffer[j]) if least else max(buffer[i], buffer[j])


@leaf
def until(buffer: Floats, left: int, right: int, a: int, b: int) -> float:
    """max over k in [a, b] of min(right[k - a], min left[0 : k])."""
    kept, best = np.inf, -np.inf
    for k in range(a):
        kept = min(kept, buffer[left + k])
    for k in range(b - a + 1):
        best = max(best, min(buffer[right + k], kept))
        if kept <= best:  # `kept` never rises, so no later k can be better
            break
        if a + k < b:
            kept = min(kept, buffer[left + a + k])
    return best
