"""Due dates: by which step a literal has to hold, and when it must not fail, after a prefix.

This works for any formula and needs no tables. Suppose that a literal fails at some of the steps to come and
that everything else is unknown: the sound upper bound on rho then says whether the formula could still be
satisfied. If it could not, the literal is due. Bisection finds the step from which on that is so. Signals are
taken to keep their last value.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, copy_row
from specshield.compiled import kernel, leaf
from specshield.policy.planner.literals import LAST, PREDICATE, SIDE, PackedLiterals
from specshield.policy.progress import fill_place
from specshield.stl.program import evaluate_packed
from specshield.stl.tree import ALWAYS, EVENTUALLY, UNTIL, Tree, tree_bounds

NO_DATE = 1 << 40  # later than every step: the literal is not due


class Bounds(NamedTuple):
    """Bounds on every leaf at every step, each (size,), and as many again to change them on trial."""

    low: Floats
    high: Floats
    trial_low: Floats
    trial_high: Floats


@kernel
def make_bounds(size: int) -> Bounds:
    return Bounds(np.empty(size), np.empty(size), np.empty(size), np.empty(size))


@leaf
def read_pose(
    literals: PackedLiterals, x: float, y: float, theta: float, values: Floats, stack: Floats, rho: Floats
) -> None:
    """The predicates' robustness at a pose, into rho (P,). values (3 + R + S,) holds the signals already."""
    fill_place(literals.formula.regions, x, y, theta, values)
    for p in range(rho.shape[0]):
        n = literals.predicate[p, 0]
        rho[p] = literals.predicate[p, 1] * evaluate_packed(n, literals.formula.tree.programs, values, stack)


@leaf
def read_signals(literals: PackedLiterals, values: Floats, stack: Floats, held: Floats) -> None:
    """Writes the constant value of each leaf that reads signals alone into held (l,), 0 for other leaves."""
    for n in range(held.shape[0]):
        held[n] = 0.0
        if literals.leaf[n, 0] < 0:
            held[n] = evaluate_packed(n, literals.formula.tree.programs, values, stack)


@leaf
def note(literals: PackedLiterals, t: int, rho: Floats, held: Floats, known: Floats) -> None:
    """Writes the leaves at step t into known (size,)."""
    tree = literals.formula.tree
    for n in range(held.shape[0]):
        if tree.leaf_start[n] <= t < tree.leaf_stop[n]:
            p = literals.leaf[n, 0]
            value = held[n] if p < 0 else literals.leaf[n, 1] * rho[p]
            known[tree.leaf_at[n] + t - tree.leaf_start[n]] = value


@leaf
def foresee(literals: PackedLiterals, s: int, known: Floats, held: Floats, bounds: Bounds) -> None:
    """Writes the leaves' bounds after a prefix that ends with step s into bounds.low and bounds.high."""
    tree, low, high = literals.formula.tree, bounds.low, bounds.high
    for n in range(held.shape[0]):
        at = tree.leaf_at[n] - tree.leaf_start[n]
        for t in range(tree.leaf_start[n], min(s + 1, tree.leaf_stop[n])):
            low[at + t] = high[at + t] = known[at + t]
        for t in range(max(s + 1, tree.leaf_start[n]), tree.leaf_stop[n]):
            if literals.leaf[n, 0] < 0:
                low[at + t] = high[at + t] = held[n]
            else:
                low[at + t], high[at + t] = tree.low[n], tree.high[n]


@leaf
def is_open(literals: PackedLiterals, bounds: Bounds) -> bool:
    """Whether some values of what is not known yet satisfy the formula, as far as the bounds can tell."""
    _reset(bounds)
    return _is_open_on_trial(literals, bounds)


@leaf
def is_open_if(
    literals: PackedLiterals, k: int, s: int, until: int, start: int, stop: int, bounds: Bounds
) -> bool:
    """As `is_open`, if literal k holds at steps s + 1 to `until` and fails at steps `start` to `stop`."""
    _reset(bounds)
    _suppose(literals, k, s, until, start, stop, bounds)
    return _is_open_on_trial(literals, bounds)


@leaf
def _reset(bounds: Bounds) -> None:
    copy_row(bounds.low, bounds.trial_low)
    copy_row(bounds.high, bounds.trial_high)


@leaf
def _is_open_on_trial(literals: PackedLiterals, bounds: Bounds) -> bool:
    _, highest = tree_bounds(literals.formula.tree, bounds.trial_low, bounds.trial_high)
    return highest > literals.margin


@leaf
def _suppose(
    literals: PackedLiterals, k: int, s: int, until: int, start: int, stop: int, bounds: Bounds
) -> None:
    """Changes the bounds on trial to what `is_open_if` supposes of literal k."""
    tree, margin, low, high = literals.formula.tree, literals.margin, bounds.trial_low, bounds.trial_high
    for n in range(literals.leaf.shape[0]):
        if literals.leaf[n, 0] != literals.literal[k, PREDICATE]:
            continue
        begin, end = tree.leaf_start[n], tree.leaf_stop[n]
        at, same = tree.leaf_at[n] - begin, literals.leaf[n, 1] == literals.literal[k, SIDE]
        if same:
            for i in range(at + max(s + 1, begin), at + min(until + 1, end)):
                low[i] = high[i] = np.inf
        for i in range(at + max(start, begin), at + min(stop + 1, end)):
            low[i] = min(low[i], margin) if same else max(low[i], -margin)
            high[i] = min(high[i], margin) if same else max(high[i], -margin)


@leaf
def due_date(literals: PackedLiterals, k: int, s: int, guess: int, bounds: Bounds) -> int:
    """The step by which literal k has to have held at some step after s; NO_DATE if it may fail for ever.

    guess: the step to try first, which saves time if it is right.
    """
    last = literals.literal[k, LAST]
    low, high, tried = s, last + 1, guess if s < guess <= last else last
    while high - low > 1:
        if is_open_if(literals, k, s, s, s + 1, tried, bounds):
            low, after = tried, last
        else:
            high, after = tried, tried - 1
        tried = after if tried == guess and low < after else (low + high) // 2
    return high if high <= last else NO_DATE


@leaf
def needed_until(
    literals: PackedLiterals, k: int, s: int, begin: int, stop: int, goal: int, bounds: Bounds
) -> int:
    """The last step up to which literal k has to hold at every step from `begin` on, at most stop - 1;
    begin - 1 if it need not hold at `begin`. goal: -1, or a literal that is supposed to fail from step s + 1
    on, as the right side of an `until` does while its left side has to hold.
    """
    low, high, tried = begin - 1, min(literals.literal[k, LAST] + 1, stop), begin
    while high - low > 1:
        _reset(bounds)
        if goal >= 0:
            _suppose(literals, goal, s, s, s + 1, tried, bounds)
        _suppose(literals, k, s, s, tried, tried, bounds)
        if _is_open_on_trial(literals, bounds):
            high = tried
        else:
            low = tried
        tried = (low + high) // 2
    return low


@leaf
def stay_for(literals: PackedLiterals, k: int, s: int, by: int, most: int, bounds: Bounds) -> int:
    """The fewest steps to stay where literal k holds at step s, after which it is no longer due at step `by`
    and may fail for at least one step; most + 1 if `most` steps are not enough.
    """
    low, high, tried = -1, most + 1, 0
    while high - low > 1:
        over = s + tried + 1
        if is_open_if(literals, k, s, s + tried, over, max(by, over), bounds):
            high = tried
        else:
            low = tried
        tried = (low + high) // 2
    return high


def cost_of(tree: Tree) -> float:
    """What one evaluation of the bounds costs [about us]."""
    work = 4.0 * tree.size
    for op, length, a, b in zip(tree.op, tree.length, tree.a, tree.b, strict=True):
        if op in (ALWAYS, EVENTUALLY):
            passes = math.log2(b - a + 1) + 1 if length > 1 else b - a + 1
        else:
            passes = b + 1 if op == UNTIL else 1
        work += 2.0 * length * passes
    return 1e-3 * work
