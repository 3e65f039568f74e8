"""The robustness of what a prefix leaves open of a formula, with each deadline met some steps early.

Conjuncts that the prefix has settled are left out; a visit may need some robustness to count. An F or U has
to be met so many steps before its window ends, unless the prefix has met it. What a G asks for has to hold
from so many steps before the G begins, and likewise for an F whose window is short and far away. A G at the
top that has begun counts from the first step at which its child is open. Below a `not`, a G is treated as an
F and an F as a G.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints, copy_row
from specshield.caution.residual import all_of
from specshield.compiled import Boxed, box, kernel, leaf
from specshield.rule.values import places
from specshield.rule.view import View, view_of
from specshield.stl import SATISFIED_ABOVE, Always, Eventually, Formula, conjuncts
from specshield.stl.conjunction import flat, is_predicate
from specshield.stl.tree import ALWAYS, EVENTUALLY, UNTIL, Tree, apply, bounds_at, compile_tree, slide, until
from specshield.task import Task, kept_with_task

OTHER = -1  # the kind of a conjunct that is neither F nor G


class Conjuncts(NamedTuple):
    """A conjunction of K formulas, over the l leaves of its tree.

    below: the tree of n nodes without the `and`, and without the F or G at the top of each conjunct. kind
    [K]: ALWAYS or EVENTUALLY for that G or F; OTHER: the whole conjunct is in `below`. at [K]: where in the
    buffer the values in its window begin. a, b [K]: its window [steps]. horizon [K]: of its child [steps].
    lead [K]: half of the time until its window if that `is_far`, else 0 [steps]. half [K]: the most slack of
    the rest, which is half of the longest window of an F or U, or of the time until a window in `below` that
    is far [steps]. plain [K]: whether the child is a predicate or, under F, a G of one. owner [n]: the
    conjunct of each node; -1 for a node that cannot be met early. seeker [l]: the conjunct of a leaf that has
    to be true at some step of an F or U, -1 for any other leaf.
    """

    below: Tree
    kind: Ints
    at: Ints
    a: Ints
    b: Ints
    horizon: Ints
    lead: Ints
    half: Ints
    plain: Bools
    owner: Ints
    seeker: Ints


@kept_with_task
def conjunction_of(task: Task, formula: Formula) -> tuple[Boxed[View] | None, Boxed[Conjuncts]]:
    """The formula's conjuncts, and the view that has their leaves; None if that is the formula's own view."""
    above = (formula,) if is_predicate(formula) else conjuncts(formula)  # as in the tree
    above = tuple(flat(part) if isinstance(part, Always) else part for part in above)
    whole, slots = all_of(above), places(task)
    tree = compile_tree(whole, slots, True)
    rows, kept, size = list[tuple[int, ...]](), list[bool](), 0
    owner, seeker = list[int](), list[int]()
    for k, part in enumerate(above):
        each, row = compile_tree(part, slots, True), (OTHER, size, 0, 0, part.horizon, 0)
        seeks = np.where(each.op == ALWAYS, each.turned, (each.op > ALWAYS) & ~each.turned)
        lead = np.where((each.op == UNTIL) | (each.right <= each.at), 0, each.a // 2)
        half, rest = np.where(seeks, each.b - each.a, 0) // 2, len(each.op)
        if isinstance(part, (Always, Eventually)):
            rest -= 1
            at_once = lead[rest] > 0 and part.a == part.b and is_predicate(part.child)
            kind = ALWAYS if at_once else each.op[rest]
            row = (kind, size + each.right[rest], part.a, part.b, part.child.horizon, lead[rest])
        rows.append((*row, max(half.max(initial=0), lead[:rest].max(initial=0))))
        kept += [True] * rest + [False] * (len(each.op) - rest + (k > 0))  # without the `and`
        owner += np.where(np.maximum(half, lead) > 0, k, -1)[:rest].tolist()
        seeker += np.where(each.sought, k, -1).tolist()
        size += each.size
    below = tree._replace(**{name: getattr(tree, name)[kept] for name in tree._fields[:8]})  # of its nodes
    columns, plain = np.array(rows, np.int64).T.copy(), np.array([*map(_is_plain, above)], np.bool_)
    parts = Conjuncts._make((below, *columns, plain, *(np.array(of, np.int64) for of in (owner, seeker))))
    same = whole == formula and tree.size == view_of(task, formula).value.tree.size  # no window is far
    return None if same else view_of(task, whole, True), box(parts)


def _is_plain(part: Formula) -> bool:
    inner = part.child if isinstance(part, Eventually) and isinstance(part.child, Always) else part
    return isinstance(inner, (Always, Eventually)) and inner.child.horizon == 0


@kernel
def find_open(
    boxed: Boxed[Conjuncts], known: Floats, t: int, visits: Floats, still: Bools, settled: Floats
) -> Floats:
    """Writes into still (K,) which conjuncts x_{0:t} has not settled, and into settled (K,) above which
    robustness past visits count for each conjunct. Returns the lower bounds of all nodes, (size,).

    known (size,): the leaves to step t. visits (K,): the robustness above which past visits are to count; a
    conjunct that can no longer be so robust counts every visit.
    """
    parts, low, high = boxed.value, known.copy(), known.copy()
    bounds_at(parts.below, t, low, high)
    for k in range(settled.shape[0]):
        had = _value(parts, k, parts.a[k], parts.b[k], high) > visits[k]
        settled[k] = visits[k] if had else SATISFIED_ABOVE
    copy_row(known, low)
    if not _settle(parts, t, settled, low):  # every past visit counts anyway
        settled[:] = SATISFIED_ABOVE
    bounds_at(parts.below, t, low, low.copy())
    for k in range(still.shape[0]):
        still[k] = not _value(parts, k, parts.a[k], parts.b[k], low) > settled[k]
    return low


@leaf
def _settle(parts: Conjuncts, t: int, settled: Floats, buffer: Floats) -> bool:
    """In `buffer` (size,), sets the leaves to step t to inf where they count and to -inf where they do not
    hold. Leaves that hold but do not count keep their values; returns whether there are any. settled (K,):
    see `find_open`.
    """
    less = False
    for n in range(parts.below.leaf_at.shape[0]):
        first = parts.below.leaf_at[n] - parts.below.leaf_start[n]
        enough = settled[parts.seeker[n]] if parts.seeker[n] >= 0 else SATISFIED_ABOVE
        for i in range(parts.below.leaf_at[n], first + min(parts.below.leaf_stop[n], t + 1)):
            if buffer[i] > enough:
                buffer[i] = np.inf
            elif buffer[i] > SATISFIED_ABOVE:
                less = True
            else:
                buffer[i] = -np.inf
    return less


@kernel
def rate_open(
    boxed: Boxed[Conjuncts], still: Bools, t: int, settled: Floats, early: Ints, leaves: Floats, rho: Floats
) -> None:
    """Writes rho (N,) of the conjuncts that are `still` (K,) open, each F and U met early (K,) steps before
    its end, though a window keeps at least half its length; what a window that is far asks for has to hold as
    many steps before it. If nothing is open, rho is that of the whole formula.

    settled (K,): see `find_open`. leaves (N, size): the leaves along N trajectories.
    """
    parts, some = boxed.value, still.any()
    buffer, scratch = np.empty(leaves.shape[1]), np.empty(leaves.shape[1])
    for f in range(leaves.shape[0]):
        copy_row(leaves[f], buffer)
        if some:
            _settle(parts, t, settled, buffer)
        for n in range(parts.owner.shape[0]):
            sooner = early[parts.owner[n]] if some and parts.owner[n] >= 0 else 0
            _apply_early(parts.below, n, t, sooner, buffer, scratch)
        least = np.inf
        for k in range(still.shape[0]):
            a, b = parts.a[k], parts.b[k]
            lead = min(early[k], parts.lead[k]) if some and a > t else 0
            if some and parts.kind[k] == EVENTUALLY:
                lead -= b - a
                b = max(b - min(early[k], (b - a) // 2), min(b, t))
            elif some and parts.kind[k] == ALWAYS:
                a = max(a, min(t + 1 - parts.horizon[k], b))
            if still[k] or not some:
                least = min(least, _value(parts, k, a, b, buffer))
                for i in range(parts.at[k] - lead, parts.at[k]):
                    least = min(least, buffer[i])
        rho[f] = least


@leaf
def _apply_early(tree: Tree, n: int, t: int, early: int, buffer: Floats, scratch: Floats) -> None:
    """Applies node n of `parts.below` as `rate_open` says. buffer, scratch (size,): both overwritten."""
    op, at, right, count, a, b = tree.op[n], tree.at[n], tree.right[n], tree.length[n], tree.a[n], tree.b[n]
    turned, past = tree.turned[n], t - tree.start[n]
    seeks = (op == ALWAYS) == turned
    sooner = min(early, (b - a) // 2) if seeks else 0
    if early == 0:
        apply(tree, n, buffer)
    elif op == UNTIL:
        for i in range(count):
            buffer[at + i] = until(buffer, at + i, right + i, a, max(b - sooner, min(b, past - i)))
    else:
        length, lead = b - a + 1 - sooner, min(early, a // 2) - (b - a if seeks else 0) if right > at else 0
        copy_row(buffer, scratch)
        slide(buffer, at, right, count, length, op == ALWAYS)
        for i in range(count):
            value = buffer[at + i]
            for j in range(i + length, min(i + length + sooner, past - a + 1)):  # late, but done
                value = min(value, scratch[right + j]) if turned else max(value, scratch[right + j])
            for j in range(i + a - (lead if i + a > past else 0), i + a):  # before its window
                value = max(value, scratch[at + j]) if turned else min(value, scratch[at + j])
            buffer[at + i] = value


@leaf
def _value(parts: Conjuncts, k: int, a: int, b: int, buffer: Floats) -> float:
    """rho of conjunct k from the values of its child, with the window [a, b] in place of its own."""
    first = parts.at[k] - parts.a[k]
    value = buffer[first + a]
    for i in range(first + a + 1, first + b + 1):
        value = max(value, buffer[i]) if parts.kind[k] == EVENTUALLY else min(value, buffer[i])
    return float(value + 0.0)
