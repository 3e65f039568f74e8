"""Rules whose deadlines come earlier, for ways that leave time for what may go wrong."""

from __future__ import annotations

from dataclasses import replace

from specshield.arrays import Floats
from specshield.reasons.still_open import bounds_after, still_open
from specshield.stl import SATISFIED_ABOVE, Always, And, Eventually, Formula, Implies, Or, Until
from specshield.task import Task


def earlier_rule(task: Task, formula: Formula, early: int, poses: Floats, rows: Floats) -> Formula:
    """What x_{0:t} leaves open of the formula, with deadlines that come `early` steps earlier: the ends of F
    and U that can still be met so early, whose windows keep at least half of their length, and the begin of
    each G to come that does not hold at x_t. The formula itself follows from this, since only negations are
    left as they are.

    poses [t + 1, 3], rows [t + 1, S]: the signals.
    """
    t = len(poses) - 1

    def end(a: int, b: int, from_0: bool) -> int:
        last = b - min(early, (b - a) // 2)
        return b if from_0 and last <= t else last

    def sooner(part: Formula, from_0: bool = True) -> Formula:
        """from_0: whether the part's window counts from step 0, and not from a step of another window."""
        match part:
            case Eventually(a, b, child):
                return Eventually(a, end(a, b, from_0), sooner(child, False))
            case Until(a, b, left, right):
                return Until(a, end(a, b, from_0), left, sooner(right, False))
            case Always(a, b, child) if from_0 and a > t + 1 and child.horizon == 0:
                holds = bounds_after(task, Always(t, t, child), poses, rows)[0] > SATISFIED_ABOVE
                return part if holds else Always(max(a - early, t + 1), b, child)
            case Always(a, b, child):
                return Always(a, b, sooner(child, False))
            case And(children) | Or(children):
                return replace(part, children=tuple(sooner(child, from_0) for child in children))
            case Implies(left, right):
                return Implies(left, sooner(right, from_0))
            case _:
                return part

    return sooner(still_open(task, formula, poses, rows))
