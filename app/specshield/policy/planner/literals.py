"""The literals of a formula, as arrays for compiled code.

A predicate is a comparison, or a boolean combination of comparisons, that reads the pose. A literal is a
predicate or its negation, with the sign with which the formula asks for it: `G not A` asks for the literal
`not A`. Parts of the formula that read signals alone are no literals, since no motion changes them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from specshield.arrays import Ints
from specshield.caution.residual import all_of
from specshield.caution.worst import alone
from specshield.rule.view import View, view_of
from specshield.stl import Always, And, Eventually, Formula, Implies, Node, Not, Or, Until, conjuncts
from specshield.stl.conjunction import is_predicate, signed
from specshield.task import Task, kept_with_task

Ends = frozenset[tuple[Formula, int]]

SINGLE_STEPS = 16  # in which a plan may go on by single steps; chosen by hand, nothing measured
PREDICATE, SIDE, LAST, GUARDS = range(4)  # the columns of PackedLiterals.literal


class Literal(NamedTuple):
    """A predicate, or its negation where `side` is -1.

    guards: whether an `always`, or the left side of an `until`, asks for it, so that it has to hold for a
    while. ends: if nothing but `until` asks for that, the literals (predicate, side) of the right sides, any
    of which may end the while.
    """

    predicate: Formula
    side: int
    guards: bool
    ends: Ends


class PackedLiterals(NamedTuple):
    """A formula of P predicates and L literals over a task; its tree has l leaves.

    formula: the view of the formula that `separate` returns. leaf [l, 2]: the predicate of each leaf, -1 if
    it reads signals alone; and -1 if the leaf is the predicate's negation, else 1. predicate [P, 2]: one leaf
    that is the predicate or its negation, and -1 for the negation. literal [L, 4]: the columns PREDICATE;
    SIDE, -1 for the negation; LAST, the last step at which some leaf reads it; GUARDS, 1 or 0. margin: a
    literal holds, and the formula is satisfied, if its robustness is above this.
    """

    formula: View
    leaf: Ints
    predicate: Ints
    literal: Ints
    margin: float


@kept_with_task
def literals_of(task: Task, formula: Formula) -> tuple[PackedLiterals, tuple[Literal, ...]]:
    """The literals of the task's formula or of a part of it, in the order of `PackedLiterals.literal`."""
    formula = separate(task, formula)
    view = view_of(task, formula).value
    predicates: list[Formula] = []
    literals: dict[tuple[int, int], Literal] = {}
    leaves: list[tuple[int, int]] = []
    last: dict[tuple[int, int], int] = {}
    examples: list[tuple[int, int]] = []
    for n, (found, positive, ends) in enumerate(_leaves(formula, True, None)):
        base, sign = _without_not(found)
        if alone(task, base):
            leaves.append((-1, sign))
            continue
        if base not in predicates:
            predicates.append(base)
            examples.append((n, sign))
        p = predicates.index(base)
        leaves.append((p, sign))
        key = (p, sign if positive else -sign)
        known = literals.get(key, Literal(base, key[1], False, frozenset()))
        if ends is not None:
            known = known._replace(guards=True, ends=known.ends & ends if known.guards else ends)
        literals[key] = known
        last[key] = max(last.get(key, 0), int(view.tree.leaf_stop[n]) - 1)
    rows = [(*key, last[key], int(literal.guards)) for key, literal in literals.items()]
    packed = PackedLiterals(view, _columns(leaves, 2), _columns(examples, 2), _columns(rows, 4), 0.0)
    return packed, tuple(literals.values())


def _columns(rows: Sequence[tuple[int, ...]], n: int) -> Ints:
    return np.array(rows, np.int64).reshape(-1, n)


def separate(task: Task, formula: Formula) -> Formula:
    """The same formula, of the same robustness, in which no leaf joins signals to the pose by `and`, `or` or
    `implies`. A part that reads signals alone is put under G[0,0], which makes it a leaf of its own.
    """
    joins = isinstance(formula, And | Or | Implies) and not alone(task, formula)

    def apart(part: object) -> object:
        if isinstance(part, tuple):
            return tuple(map(apart, part))
        if not isinstance(part, Formula):
            return part
        if joins and alone(task, part):
            return part if part.horizon else Always(0, 0, part)
        return separate(task, part)

    return replace(formula, **{field.name: apart(getattr(formula, field.name)) for field in fields(formula)})


def released(formula: Formula) -> Formula:
    """A formula of the same robustness, in which a conjunct `not (p U[a,b] q)` says that q fails throughout,
    or up to a step at which p fails too. As it stands, q would be due to fail at every next step, and plans
    would go on by single steps.
    """
    said = list(parts := conjuncts(formula))
    for i, part in enumerate(parts):
        match part:
            case Not(Until(a, b, p, q)) if b > SINGLE_STEPS and is_predicate(p) and is_predicate(q):
                neither = And((signed(p, True), signed(q, True)))
                kept = Or((Always(0, b - a, Not(q)), Until(0, b - a, Not(q), neither)))
                said[i] = Or((Eventually(0, a - 1, Not(p)), Eventually(a, a, kept))) if a else kept
    return formula if said == [*parts] else all_of(said)


def leading(literal: Literal) -> tuple[Formula, int]:
    """The predicate and side of a literal's first part, to which a field may lead if none leads to all."""
    whole = literal.predicate
    return _without_not(whole.children[0] if isinstance(whole, And) else whole)


def _without_not(predicate: Node) -> tuple[Formula, int]:
    """The predicate below the negations, and -1 where their number is odd."""
    sign = 1
    while isinstance(predicate, Not):
        predicate, sign = predicate.child, -sign
    assert isinstance(predicate, Formula)
    return predicate, sign


def _leaves(
    formula: Formula, positive: bool, ends: Ends | None
) -> Iterator[tuple[Formula, bool, Ends | None]]:
    """The leaves in the order of `compile_tree`, each with its polarity and with the literals that may end
    the while for which it has to hold. These are None if it need not hold for a while, and empty if nothing
    but time ends that.
    """
    match formula:
        case _ if is_predicate(formula):
            yield formula, positive, ends
        case Not(child):
            yield from _leaves(child, not positive, ends)
        case And(children) | Or(children):
            for child in children:
                yield from _leaves(child, positive, ends)
        case Implies(left, right):
            yield from _leaves(left, not positive, ends)
            yield from _leaves(right, positive, ends)
        case Always(a, b, child) | Eventually(a, b, child):
            always: Ends | None = frozenset() if isinstance(formula, Always) is positive else None
            yield from _leaves(child, positive, always if b > a else ends)
        case Until(a, b, left, right):
            if b > 0:
                yield from _leaves(left, positive, _literals_in(right) if positive else None)
            yield from _leaves(right, positive, None if positive else frozenset())


def _literals_in(formula: Formula) -> Ends:
    """The literals that the formula asks for."""
    found = ((_without_not(leaf), positive) for leaf, positive, _ in _leaves(formula, True, None))
    return frozenset((base, sign if positive else -sign) for (base, sign), positive in found)
