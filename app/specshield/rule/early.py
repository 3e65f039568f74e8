"""What a prefix leaves open of a formula, with each F and U met some steps early.

What the prefix has settled is left out. An F or U is asked for so many steps before its window ends, or where
it is met already; a G of a predicate that has yet to begin, or what a short window far away asks for, so many
steps before; any other G from the first step on at which its child is open. What is below a `not` stays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints, copy_row
from specshield.compiled import kernel, leaf
from specshield.rule.residual import joined
from specshield.rule.values import places
from specshield.stl import SATISFIED_ABOVE, Always, Arithmetic, Eventually, Formula, Node, Number, conjuncts
from specshield.stl.conjunction import flat, is_predicate
from specshield.stl.tree import ALWAYS, EVENTUALLY, UNTIL, Tree, apply, bounds_at, compile_tree, slide, until
from specshield.task import Task, kept_with_task

OTHER = -1  # beside a tree's operators


class Conjuncts(NamedTuple):
    """A conjunction of K formulas, over the leaves of its tree.

    below: the tree without the F or G at the top of each conjunct, and the `and`. kind [K]: what that is;
    OTHER: none, all is in `below`. at [K]: where in the buffer values begin that it ranges over. a, b [K]:
    its window [steps]. horizon [K]: of what is below [steps]. half [K]: half of the longest window of an F or
    U in it [steps]; of a G whose values are in the buffer from step 0 on, half of the time until it begins.
    plain [K]: whether what is below is a predicate, or under F a G of one. owner [n]: each node's conjunct;
    -1 where it is `turned`, and a shorter window would ask for less.
    """

    below: Tree
    kind: Ints
    at: Ints
    a: Ints
    b: Ints
    horizon: Ints
    half: Ints
    plain: Bools
    owner: Ints


@kept_with_task
def conjunction_of(task: Task, formula: Formula) -> tuple[Formula, Conjuncts]:
    """The formula's conjuncts, and the one that has their leaves: itself, or an equal one but for its G that
    begin later, which it has from step 0 on.
    """
    above, slots = (formula,) if is_predicate(formula) else conjuncts(formula), places(task)  # as in the tree
    above = tuple(flat(part) if isinstance(part, Always) else part for part in above)
    wide = [_from_now_on(part) for part in above]
    whole = formula if joined(wide) == formula else joined(wide)
    tree = compile_tree(whole, slots)
    rows, kept, owner, size = list[tuple[int, ...]](), list[bool](), list[int](), 0
    for k, part in enumerate(above):
        own, row, early = compile_tree(wide[k], slots), (OTHER, size, 0, 0, part.horizon), wide[k] is not part
        rest = len(own.op)
        if isinstance(part, (Always, Eventually)):
            rest, row = rest - 1, (own.op[-1], size + part.a * early, part.a, part.b, part.child.horizon)
        halves = (own.b - own.a)[np.isin(own.op, (EVENTUALLY, UNTIL)) & ~own.turned] // 2
        rows.append((*row, halves.max(initial=row[2] // 2 * early)))
        kept += [True] * rest + [False] * (len(own.op) - rest + (k > 0))  # without the `and`
        owner += np.where(own.turned, -1, k)[:rest].tolist()
        size += own.size
    below = tree._replace(**{name: getattr(tree, name)[kept] for name in tree._fields[:7]})  # of its nodes
    columns, plain = np.array(rows, np.int64).T.copy(), np.array([*map(_is_plain, above)], np.bool_)
    return whole, Conjuncts._make((below, *columns, plain, np.array(owner, np.int64)))


def _from_now_on(part: Formula) -> Formula:
    """A conjunct; from step 0 on if it is a G of a predicate, or an F of one or of such a G whose window is
    short and far away, unless the predicate may be no number before.
    """
    if not isinstance(part, (Always, Eventually)) or part.a <= 1 or not _is_plain(part) or _may_fail(part):
        return part
    if isinstance(part, Always) or (part.a == part.b and is_predicate(part.child)):
        return Always(0, part.b, part.child)
    return Eventually(0, part.b, part.child) if part.b - part.a < part.a // 2 else part


def _may_fail(node: Node) -> bool:
    match node:
        case Arithmetic("+" | "-") | Arithmetic("*", Number()) | Arithmetic("*" | "/", _, Number()):
            return any(map(_may_fail, node.parts))
    return isinstance(node, Arithmetic) or any(map(_may_fail, node.parts))


def _is_plain(part: Formula) -> bool:
    inner = part.child if isinstance(part, Eventually) and isinstance(part.child, Always) else part
    return isinstance(inner, (Always, Eventually)) and inner.child.horizon == 0


@kernel
def find_open(parts: Conjuncts, known: Floats, t: int, still: Bools) -> None:
    """Writes which conjuncts x_{0:t} has not settled into still (K,). known (size,): the leaves to step t."""
    low = known.copy()
    bounds_at(parts.below, t, low, known.copy())
    for k in range(still.shape[0]):
        still[k] = not _value(parts, k, parts.a[k], parts.b[k], low) > SATISFIED_ABOVE


@kernel
def rate_open(parts: Conjuncts, still: Bools, t: int, early: Ints, leaves: Floats, rho: Floats) -> None:
    """rho (N,) of the conjuncts that are `still` (K,) open, each F and U met early (K,) steps before its end
    and each G that is to begin kept so many steps before, though a window keeps at least half its length.

    leaves (N, size): the leaves along N trajectories. Where nothing is open, rho is that of the whole.
    """
    buffer, scratch, some = np.empty(leaves.shape[1]), np.empty(leaves.shape[1]), still.any()
    for f in range(leaves.shape[0]):
        copy_row(leaves[f], buffer)
        for n in range(parts.below.leaf_at.shape[0] if some else 0):  # what is settled asks for no margin
            first = parts.below.leaf_at[n] - parts.below.leaf_start[n]
            for i in range(parts.below.leaf_at[n], first + min(parts.below.leaf_stop[n], t + 1)):
                buffer[i] = np.inf if buffer[i] > SATISFIED_ABOVE else -np.inf
        for n in range(parts.owner.shape[0]):
            sooner = early[parts.owner[n]] if some and parts.owner[n] >= 0 else 0
            _apply_early(parts.below, n, t, sooner, buffer, scratch)
        least = np.inf
        for k in range(still.shape[0]):
            a, b = parts.a[k], parts.b[k]
            if some and parts.kind[k] == EVENTUALLY:
                end = min(early[k], (b - a) // 2)
                b = max(b - end, min(b, t))
                lead = min(early[k], parts.half[k]) - end if parts.plain[k] and a > t else 0
                for i in range(parts.at[k] + b - a, parts.at[k] - 1, -1):
                    buffer[i] = buffer[i - lead : i + 1].min()
            elif some and parts.kind[k] == ALWAYS:
                later = a > t and parts.plain[k]
                a = a - min(early[k], parts.half[k]) if later else max(a, min(t + 1 - parts.horizon[k], b))
            if still[k] or not some:
                least = min(least, _value(parts, k, a, b, buffer))
        rho[f] = least


@leaf
def _apply_early(tree: Tree, n: int, t: int, early: int, buffer: Floats, scratch: Floats) -> None:
    """Applies node n below the conjuncts as `rate_open` says. buffer, scratch (size,): both overwritten."""
    op, at, count, a, b = tree.op[n], tree.at[n], tree.length[n], tree.a[n], tree.b[n]
    sooner, past = min(early, (b - a) // 2), t - tree.start[n]
    if op == UNTIL:
        for i in range(count):
            buffer[at + i] = until(buffer, at + i, tree.right[n] + i, a, max(b - sooner, min(b, past - i)))
    elif op != EVENTUALLY or sooner == 0:
        apply(tree, n, buffer)
    else:
        length = b - a + 1 - sooner
        copy_row(buffer, scratch)
        slide(buffer, at, count, length, False)
        for i in range(min(count, past - a - length + 1)):
            for j in range(i + length, min(i + length + sooner, past - a + 1)):
                buffer[at + i] = max(buffer[at + i], scratch[at + j])


@leaf
def _value(parts: Conjuncts, k: int, a: int, b: int, buffer: Floats) -> float:
    """rho of conjunct k, with the window [a, b] for its own, from what is below it."""
    first = parts.at[k] - parts.a[k]
    value = buffer[first + a]
    for i in range(first + a + 1, first + b + 1):
        value = max(value, buffer[i]) if parts.kind[k] == EVENTUALLY else min(value, buffer[i])
    return float(value + 0.0)
