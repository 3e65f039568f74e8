"""What can still be kept of a formula that is already violated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from specshield.stl import SATISFIED_ABOVE, Always, And, Formula, conjuncts, robustness_bounds


def residuals(formula: Formula, prefix: Mapping[str, NDArray[np.float64]], t: int) -> Iterator[Formula]:
    """What is left to keep after a prefix that violates, the most demanding first.

    prefix {name: [t + 1]}. The broken conjuncts are dropped, a broken G is enforced again from t + 1; and
    where even that cannot be (the robot is still inside), without those. Nothing is yielded where no conjunct
    is left.
    """
    kept, broken = left_over(formula, prefix, t)
    if broken:
        yield joined([*kept, *again(broken, t + 1)])
    if kept:
        yield joined(kept)


def left_over(
    formula: Formula, prefix: Mapping[str, NDArray[np.float64]], t: int
) -> tuple[list[Formula], list[Always]]:
    """The conjuncts that can still be kept, and the broken G whose windows are not over."""
    kept: list[Formula] = []
    broken: list[Always] = []
    for conjunct in conjuncts(formula):
        _, high = robustness_bounds(conjunct, {name: prefix[name] for name in conjunct.names})
        if high > SATISFIED_ABOVE:
            kept.append(conjunct)
        elif isinstance(conjunct, Always) and conjunct.b > t:
            broken.append(conjunct)
    return kept, broken


def again(broken: Sequence[Always], t: int) -> list[Formula]:
    """The broken G whose windows are not over by step t, enforced from then on."""
    return [Always(max(each.a, t), each.b, each.child) for each in broken if each.b >= t]


def joined(parts: Sequence[Formula]) -> Formula:
    return parts[0] if len(parts) == 1 else And(tuple(parts))
