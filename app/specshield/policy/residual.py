"""What can still be kept of a formula that is already violated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from specshield.stl import (
    SATISFIED_ABOVE,
    Always,
    And,
    Eventually,
    Formula,
    Not,
    conjuncts,
    robustness_bounds,
)


def residuals(formula: Formula, prefix: Mapping[str, NDArray[np.float64]], t: int) -> Iterator[Formula]:
    """What is left to keep after a prefix that violates, the most demanding first.

    prefix {name: [t + 1]}. The broken conjuncts are dropped, a broken G is enforced again from t + 1; and
    where even that cannot be (the robot is still inside), without those. Nothing is yielded where no conjunct
    is left.
    """
    kept: list[Formula] = []
    again: list[Formula] = []
    for conjunct in conjuncts(formula):
        _, high = robustness_bounds(conjunct, {name: prefix[name] for name in conjunct.names})
        if high > SATISFIED_ABOVE:
            kept.append(conjunct)
            continue
        match conjunct:
            case Always(a, b, child) if b > t:
                again.append(Always(max(a, t + 1), b, child))
            case Not(Eventually(a, b, child)) if b > t:
                again.append(Always(max(a, t + 1), b, Not(child)))
    for parts in ([*kept, *again], kept) if again else (kept,):
        if parts:
            yield parts[0] if len(parts) == 1 else And(tuple(parts))
