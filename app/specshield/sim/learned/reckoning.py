"""How the model keeps count of where it has come since it began, from the actions that were executed.

It is given no pose and no map. A move counts as a whole one if the range scan changed at all, and as none if
it did not. Slips, walls that stop a move short and noise make the count wrong, and nothing corrects it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specshield.arrays import Ints
from specshield.robot import STRETCH
from specshield.sim.senses import RAYS

MOVES = np.array([*((a.translate, a.rotate) for a in STRETCH.actions), (0.0, 0.0)])  # at last: nothing yet
CHANGED = 0.005  # [m] that some range has to change by


class Reckoning:
    """Of n robots.

    place [n, 3]: x, y [m] and heading [rad] from where, and how, each one began. futile [n, A + 1]: how often
    an action was executed since the scan changed last.
    """

    def __init__(self, n: int) -> None:
        self.place = np.zeros((n, 3))
        self.futile = np.zeros((n, len(MOVES)), np.int64)
        self._ranges = np.full((n, RAYS), np.inf)

    def count(self, ranges: NDArray[np.floating], last: Ints) -> None:
        """Goes on after `last` [n] was executed, and `ranges` [n, RAYS] [m] scanned."""
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
