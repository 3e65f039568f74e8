"""The rows of signals that formulas read: what was sent, held, or there at the start."""

from __future__ import annotations

import numpy as np

from specshield.robot import STRETCH
from specshield.rule.values import signal_rows
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid

GRID = OccupancyGrid(np.zeros((20, 20), bool), 0.1)


def test_the_rows_of_signals():
    task = make_task(GRID, STRETCH, "F[0,5] battery > 0.5", signals={"battery": 0.1})
    assert signal_rows(task, {"battery": np.array([0.2, 0.9, 0.3])}, 3).tolist() == [[0.2], [0.9], [0.3]]
    assert signal_rows(task, {}, 2).tolist() == [[0.1], [0.1]]
    assert signal_rows(task, {"battery": np.array([0.7])}, 2).tolist() == [[0.7], [0.7]]
    assert signal_rows(make_task(GRID, STRETCH, "F[0,5] x > 1"), {}, 4).shape == (4, 0)
