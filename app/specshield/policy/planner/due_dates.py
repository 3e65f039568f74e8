"""What a formula still asks for after a prefix: by when a literal has to hold, when it must not fail.

Any formula, without tables: a literal (a predicate or its negation) is made to fail at some of the steps to
come, everything else unknown, and the sound upper bound on rho tells whether the formula could still be
satisfied. Where it could not, the literal is due. Signals hold their last value.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import leaf
from specshield.rule.values import fill_place
from specshield.rule.view import View, view_of
from specshield.stl import Always, And, Eventually, Formula, Implies, Node, Not, Or, Until
from specshield.stl.program import evaluate_packed
from specshield.stl.tree import tree_bounds
from specshield.task import Task

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Ends = frozenset[tuple[Formula, int]]
NEVER = 1 << 40  # a step that does not come


class Agenda(NamedTuple):
    """A formula's leaves as P predicates and L literals.

    rule: the view of the formula as `separate` leaves it. leaf [l, 2]: which predicate each of its leaves is,
    -1 for one that reads signals alone, and -1 for its negation. predicate [P, 2]: a leaf that is the
    predicate, and -1 where that is its negation. literal [L, 4]: predicate, -1 for its negation, the last
    step at which some leaf reads it, and whether it guards (see `Literal`).
    """

    rule: View
    leaf: Ints
    predicate: Ints
    literal: Ints


class Literal(NamedTuple):
    """A predicate or (side -1) its negation.

    guards: whether an `always` or the left of an `until` asks for it, so that it is to hold for a while.
    ends: where only an `until` does, what ends that while: each a predicate and its side, as here.
    """

    predicate: Formula
    side: int
    guards: bool
    ends: Ends


@lru_cache(maxsize=64)
def agenda_of(task: Task, formula: Formula) -> tuple[Agenda, tuple[Literal, ...]]:
    """The agenda of the task's formula or of a part of it, and its literals."""
    formula = separate(task, formula)
    view = view_of(task, formula)
    predicates: list[Formula] = []
    literals: dict[tuple[int, int], Literal] = {}
    leaves: list[tuple[int, int]] = []
    last: dict[tuple[int, int], int] = {}
    examples: list[tuple[int, int]] = []
    for n, (found, positive, guards) in enumerate(_leaves(formula, True, None)):
        base, sign = _stripped(found)
        if not _reads_pose(task, base):
            leaves.append((-1, sign))
            continue
        if base not in predicates:
            predicates.append(base)
            examples.append((n, sign))
        p = predicates.index(base)
        leaves.append((p, sign))
        key = (p, sign if positive else -sign)
        known = literals.get(key, Literal(base, key[1], False, frozenset()))
        if guards is not None:
            ends = known.ends & guards if known.guards else guards
            known = known._replace(guards=True, ends=ends)
        literals[key] = known
        last[key] = max(last.get(key, 0), int(view.tree.leaf_stop[n]) - 1)
    rows = [(*key, last[key], int(literal.guards)) for key, literal in literals.items()]
    agenda = Agenda(view, _columns(leaves, 2), _columns(examples, 2), _columns(rows, 4))
    return agenda, tuple(literals.values())


def _columns(rows: Sequence[tuple[int, ...]], n: int) -> Ints:
    return np.array(rows, np.int64).reshape(-1, n)


def separate(task: Task, formula: Formula) -> Formula:
    """The same formula, of the same robustness, with no leaf that joins signals to the pose by `and` or `or`.

    What reads signals alone is put under G[0,0], so that it is a leaf of its own.
    """
    match formula:
        case Not(child):
            return Not(_apart(task, formula, child))
        case And(children):
            return And(tuple(_apart(task, formula, child) for child in children))
        case Or(children):
            return Or(tuple(_apart(task, formula, child) for child in children))
        case Implies(left, right):
            return Implies(_apart(task, formula, left), _apart(task, formula, right))
        case Always(a, b, child):
            return Always(a, b, separate(task, child))
        case Eventually(a, b, child):
            return Eventually(a, b, separate(task, child))
        case Until(a, b, left, right):
            return Until(a, b, separate(task, left), separate(task, right))
    return formula


def _apart(task: Task, whole: Formula, child: Formula) -> Formula:
    if set(child.names) <= set(task.signals) and not set(whole.names) <= set(task.signals):
        return child if child.horizon else Always(0, 0, child)
    return separate(task, child)


def _reads_pose(task: Task, predicate: Formula) -> bool:
    return not set(predicate.names) <= set(task.signals)


def _stripped(predicate: Node) -> tuple[Formula, int]:
    sign = 1
    while isinstance(predicate, Not):
        predicate, sign = predicate.child, -sign
    assert isinstance(predicate, Formula)
    return predicate, sign


def _leaves(
    formula: Formula, positive: bool, guards: Ends | None
) -> Iterator[tuple[Formula, bool, Ends | None]]:
    """The leaves in the order of `compile_tree`: formula, polarity, and where it is to hold all along, what
    ends that.
    """
    match formula:
        case _ if not _is_temporal(formula):
            yield formula, positive, guards
        case Not(child):
            yield from _leaves(child, not positive, guards)
        case And(children) | Or(children):
            for child in children:
                yield from _leaves(child, positive, guards)
        case Implies(left, right):
            yield from _leaves(left, not positive, guards)
            yield from _leaves(right, positive, guards)
        case Always(a, b, child) | Eventually(a, b, child):
            always: Ends | None = frozenset() if isinstance(formula, Always) is positive else None
            yield from _leaves(child, positive, always if b > a else guards)
        case Until(a, b, left, right):
            if b > 0:
                yield from _leaves(left, positive, _ends(right) if positive else None)
            yield from _leaves(right, positive, None if positive else frozenset())


def _ends(right: Formula) -> Ends:
    """What may hold when the right side of an `until` does."""
    found = ((_stripped(leaf), positive) for leaf, positive, _ in _leaves(right, True, None))
    return frozenset((base, sign if positive else -sign) for (base, sign), positive in found)


def _is_temporal(formula: Node) -> bool:
    return isinstance(formula, (Always, Eventually, Until)) or any(map(_is_temporal, formula.parts))


@leaf
def read_pose(
    agenda: Agenda, x: float, y: float, theta: float, values: Floats, stack: Floats, rho: Floats
) -> None:
    """The predicates' robustness at a pose, rho (P,). values (3 + R + S,): its signals are read."""
    fill_place(agenda.rule.regions, x, y, theta, values)
    for p in range(rho.shape[0]):
        n = agenda.predicate[p, 0]
        rho[p] = agenda.predicate[p, 1] * evaluate_packed(n, agenda.rule.tree.programs, values, stack)


@leaf
def read_signals(agenda: Agenda, values: Floats, stack: Floats, held: Floats) -> None:
    """What the leaves that read signals alone keep, held (l,)."""
    for n in range(held.shape[0]):
        held[n] = 0.0
        if agenda.leaf[n, 0] < 0:
            held[n] = evaluate_packed(n, agenda.rule.tree.programs, values, stack)


@leaf
def note(agenda: Agenda, t: int, rho: Floats, held: Floats, known: Floats) -> None:
    """Writes the leaves at step t into `known`."""
    tree = agenda.rule.tree
    for n in range(held.shape[0]):
        if tree.leaf_start[n] <= t < tree.leaf_stop[n]:
            p = agenda.leaf[n, 0]
            known[tree.leaf_at[n] + t - tree.leaf_start[n]] = held[n] if p < 0 else agenda.leaf[n, 1] * rho[p]


@leaf
def foresee(agenda: Agenda, s: int, known: Floats, held: Floats, low: Floats, high: Floats) -> None:
    """The leaves' bounds after a prefix known to step s, into low and high."""
    tree = agenda.rule.tree
    for n in range(held.shape[0]):
        at = tree.leaf_at[n] - tree.leaf_start[n]
        for t in range(tree.leaf_start[n], min(s + 1, tree.leaf_stop[n])):
            low[at + t] = high[at + t] = known[at + t]
        for t in range(max(s + 1, tree.leaf_start[n]), tree.leaf_stop[n]):
            if agenda.leaf[n, 0] < 0:
                low[at + t] = high[at + t] = held[n]
            else:
                low[at + t], high[at + t] = tree.low[n], tree.high[n]


class Bounds(NamedTuple):
    """What `foresee` left, and room to judge changes of it: each (size,)."""

    low: Floats
    high: Floats
    some_low: Floats
    some_high: Floats


@leaf
def is_open(
    agenda: Agenda, k: int, s: int, until: int, start: int, stop: int, margin: float, bounds: Bounds
) -> bool:
    """Whether the formula may still be satisfied after step s if literal k holds to step `until`, by far, and
    fails from step `start` to step `stop`; k = -1: whatever happens.
    """
    low, high = bounds.some_low, bounds.some_high
    for i in range(low.shape[0]):
        low[i], high[i] = bounds.low[i], bounds.high[i]
    _suppose(agenda, k, s, until, start, stop, margin, low, high)
    _, highest = tree_bounds(agenda.rule.tree, low, high)
    return highest > margin


@leaf
def _suppose(
    agenda: Agenda,
    k: int,
    s: int,
    until: int,
    start: int,
    stop: int,
    margin: float,
    low: Floats,
    high: Floats,
) -> None:
    """Changes the bounds to what `is_open` supposes of literal k."""
    tree = agenda.rule.tree
    for n in range(agenda.leaf.shape[0]):
        if k < 0 or agenda.leaf[n, 0] != agenda.literal[k, 0]:
            continue
        begin, end, same = tree.leaf_start[n], tree.leaf_stop[n], agenda.leaf[n, 1] == agenda.literal[k, 1]
        at = tree.leaf_at[n] - begin
        if same:
            for i in range(at + max(s + 1, begin), at + min(until + 1, end)):
                low[i] = high[i] = np.inf
        for i in range(at + max(start, begin), at + min(stop + 1, end)):
            low[i] = min(low[i], margin) if same else max(low[i], -margin)
            high[i] = min(high[i], margin) if same else max(high[i], -margin)


@leaf
def due(agenda: Agenda, k: int, s: int, guess: int, margin: float, bounds: Bounds) -> int:
    """The step by which literal k has to have held at some step after s; NEVER where it may fail for good.

    guess: where to look first.
    """
    last = agenda.literal[k, 2]
    low, high, tried = s, last + 1, guess if s < guess <= last else last
    while high - low > 1:
        if is_open(agenda, k, s, s, s + 1, tried, margin, bounds):
            low, after = tried, last
        else:
            high, after = tried, tried - 1
        tried = after if tried == guess and low < after else (low + high) // 2
    return high if high <= last else NEVER


@leaf
def needed_until(agenda: Agenda, k: int, s: int, begin: int, margin: float, bounds: Bounds) -> int:
    """The last of the steps from `begin` on at each of which literal k has to hold; begin - 1 for none."""
    low, high, tried = begin - 1, agenda.literal[k, 2] + 1, begin
    while high - low > 1:
        if is_open(agenda, k, s, s, tried, tried, margin, bounds):
            high = tried
        else:
            low = tried
        tried = (low + high) // 2
    return low


@leaf
def needed_without(
    agenda: Agenda, k: int, goal: int, s: int, stop: int, margin: float, bounds: Bounds
) -> int:
    """The last of the steps from s + 1 to stop - 1 at each of which literal k has to hold while `goal` has
    not held since s, as the left of an `until`; s for none.
    """
    low, high, tried = s, min(agenda.literal[k, 2] + 1, stop), s + 1
    while high - low > 1:
        for i in range(bounds.low.shape[0]):
            bounds.some_low[i], bounds.some_high[i] = bounds.low[i], bounds.high[i]
        _suppose(agenda, goal, s, s, s + 1, tried, margin, bounds.some_low, bounds.some_high)
        _suppose(agenda, k, s, s, tried, tried, margin, bounds.some_low, bounds.some_high)
        _, highest = tree_bounds(agenda.rule.tree, bounds.some_low, bounds.some_high)
        if highest > margin:
            high = tried
        else:
            low = tried
        tried = (low + high) // 2
    return low


@leaf
def stay_for(agenda: Agenda, k: int, s: int, by: int, most: int, margin: float, bounds: Bounds) -> int:
    """The fewest steps to stay where literal k holds at step s until it is not due at `by` any more, and may
    fail for a step at least; most + 1 where `most` are not enough.
    """
    low, high, tried = -1, most + 1, 0
    while high - low > 1:
        over = s + tried + 1
        if is_open(agenda, k, s, s + tried, over, max(by, over), margin, bounds):
            high = tried
        else:
            low = tried
        tried = (low + high) // 2
    return high
