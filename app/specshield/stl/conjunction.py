"""A formula as a conjunction of others."""

from __future__ import annotations

from specshield.stl.formula import Always, And, Eventually, Formula, Implies, Node, Not, Or, Windowed


def conjuncts(formula: Formula) -> tuple[Formula, ...]:
    """The formulas that `formula` joins by `and` at its top, left to right.

    `not` moves inwards through `and`, `or`, `->`, F and G, so `not F[a,b] p` becomes `G[a,b] not p`.
    """
    return _joined(formula, negated=False)


def _joined(formula: Formula, negated: bool) -> tuple[Formula, ...]:
    """The conjuncts of `formula`, or of its negation."""
    match formula:
        case Not(child):
            return _joined(child, not negated)
        case And(children) if not negated:
            return tuple(part for child in children for part in _joined(child, False))
        case Or(children) if negated:
            return tuple(part for child in children for part in _joined(child, True))
        case Implies(left, right) if negated:
            return (*_joined(left, False), *_joined(right, True))
        case Eventually(a, b, child) if negated:
            return (Always(a, b, signed(child, True)),)
        case Always(a, b, child) if negated:
            return (Eventually(a, b, signed(child, True)),)
    return (signed(formula, negated),)


def signed(formula: Formula, negated: bool) -> Formula:
    """`formula` or its negation, without a `not not`."""
    if isinstance(formula, Not):
        return signed(formula.child, not negated)
    return Not(formula) if negated else formula


def flat(formula: Always) -> Always:
    """A G whose child is a G, written as one G."""
    while isinstance(formula.child, Always):
        inner = formula.child
        formula = Always(formula.a + inner.a, formula.b + inner.b, inner.child)
    return formula


def is_predicate(node: Node) -> bool:
    """Whether `node` has no temporal operator."""
    return not isinstance(node, Windowed) and all(is_predicate(part) for part in node.parts)
