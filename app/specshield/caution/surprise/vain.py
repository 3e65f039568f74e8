"""What a robot tried in vain: from which poses which motions led nowhere.

A mark on the map does not always explain why a motion led nowhere: the footprint may be told wrong, and marks
are doubted and forgotten. So such motions are remembered beside the marks, and futures avoid them as long as
one without them keeps the rule. Otherwise a robot may turn away and back for ever.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from specshield.arrays import Floats
from specshield.caution.surprise.barred import is_barred
from specshield.caution.surprise.contact import Near
from specshield.shield.decision import Stuck

MOST_STUCK = 16  # motions of each kind that are remembered, the newest of them
# [m], [rad] A motion that led nowhere does so from poses this near too. Two turns of a Stretch; by hand.
ALIKE: Near = (0.05, math.radians(12.0))


def halts_at(stuck: Iterable[Stuck], pose: Floats, motion: int, near: Near) -> int:
    """How often a motion did nothing at a pose (3,) and may only have slipped. motion: -1 for none."""
    if motion < 0:
        return 0
    return sum(each[3] == ~motion and _is_at(each, pose, near) for each in stuck)


def led_nowhere(stuck: Iterable[Stuck], pose: Floats, motion: int, near: Near) -> tuple[Stuck, ...]:
    """`stuck`, and that a motion leads nowhere from a pose (3,)."""
    return _newest((*worked(stuck, pose, motion, near), (*pose.tolist(), motion)))


def did_nothing(stuck: Iterable[Stuck], pose: Floats, motion: int) -> tuple[Stuck, ...]:
    """`stuck`, and that a motion did nothing at a pose (3,), but may only have slipped."""
    return _newest((*stuck, (*pose.tolist(), ~motion)))


def worked(stuck: Iterable[Stuck], pose: Floats, motion: int, near: Near) -> tuple[Stuck, ...]:
    """`stuck` without a motion that has now led away from a pose (3,)."""
    return tuple(each for each in stuck if each[3] not in (motion, ~motion) or not _is_at(each, pose, near))


def _newest(stuck: tuple[Stuck, ...]) -> tuple[Stuck, ...]:
    bars, halts = ([each for each in stuck if (each[3] >= 0) == sure][-MOST_STUCK:] for sure in (True, False))
    return (*bars, *halts)


def _is_at(stuck: Stuck, pose: Floats, near: Near) -> bool:
    return bool(is_barred(np.array([(*stuck, *near)]), pose[0], pose[1], pose[2], stuck[3]))


def barred_by(stuck: Iterable[Stuck], near: Near) -> Floats:
    """The motions that surely lead nowhere, [n, 6] (surprise/barred.py). near: what noise explains."""
    found = [(*each, *np.maximum(near, ALIKE)) for each in stuck if each[3] >= 0]
    return np.array(found, np.float64).reshape(-1, 6)
