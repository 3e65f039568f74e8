"""The model's own count of where it is since it began, from the executed actions.

It has no pose and no map. A move counts in full if the range scan changed at all, else not. Slips, walls that
stop a move and noise make the count wrong, and nothing corrects it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specshield.arrays import Ints
from specshield.robot import STRETCH
from specshield.sim.senses import RAYS

MOVES = np.array([*((a.translate, a.rotate) for a in STRETCH.actions), (0.0, 0.0)])  # the last: no action yet
CHANGED = 0.005  # [m] by which some range has to change


class Reckoning:
    """The counts of n robots.

    place [n, 3]: x, y [m] and heading [rad], relative to where each robot began. futile [n, A + 1]: how often
    each action was executed since the scan changed last.
    """

    def __init__(self, n: int) -> None:
        self.place = np.zeros((n, 3))
        self.futile = np.zeros((n, len(MOVES)), np.int64)
        self._ranges = np.full((n, RAYS), np.inf)

    def count(self, ranges: NDArray[np.floating], last: Ints) -> None:
        """Counts the executed actions `last` [n], with the scans `ranges` [n, RAYS] [m] after them."""
        moved = (np.abs(ranges - self._ranges) > CHANGED).any(axis=1)
        translate, rotate = (MOVES[last] * moved[:, None]).T
        heading = self.place[:, 2]
        self.place[:, 0] += translate * np.cos(heading)
        self.place[:, 1] += translate * np.sin(heading)
        self.place[:, 2] += rotate
        self._ranges[:] = ranges
        self.futile[moved] = 0
        stuck = np.nonzero(~moved)[0]
        self.futile[stuck, last[stuck]] += 1
