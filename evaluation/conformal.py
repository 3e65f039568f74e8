"""A margin that covers the surprises of a robot, from those seen in a calibration campaign.

Split conformal prediction (Vovk et al., 2005): of n exchangeable scores and one to come, the one to come is
at most the ceil((n + 1)(1 - alpha))-th smallest with probability at least 1 - alpha, whatever their
distribution. A score is an episode's largest surprise, so the promise is about all steps of the next one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from specshield.errors import InputError

STRIDE = 0.2  # [m] a Stretch's


def surprise(foreseen: Sequence[float], pose: Sequence[float]) -> float:
    """How far [m] the next stride may end from where it was certified to: the gap, and the heading's share.

    foreseen, pose: (x, y, theta).
    """
    turn = abs(math.remainder(pose[2] - foreseen[2], 2.0 * math.pi))
    return math.hypot(pose[0] - foreseen[0], pose[1] - foreseen[1]) + STRIDE * turn


def conformal_margin(scores: Sequence[float], alpha: float) -> float:
    """The margin [m]. Raises InputError where there are too few scores for alpha."""
    if not 0.0 < alpha < 1.0:
        raise InputError("alpha is out of range", path="alpha", got=alpha, expected="above 0 and below 1")
    rank = math.ceil((len(scores) + 1) * (1.0 - alpha))
    if rank > len(scores):
        raise InputError(
            "too few scores", path="scores", got=len(scores),
            expected=f"at least {math.ceil(1.0 / alpha) - 1} for alpha {alpha:g}",
        )  # fmt: skip
    return sorted(scores)[rank - 1]
