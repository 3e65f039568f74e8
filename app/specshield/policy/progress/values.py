"""What a policy fills into `values` at a pose (rule/values.py): all of a place, and the signals."""

from __future__ import annotations

import numpy as np

from specshield.arrays import Floats, copy_row
from specshield.compiled import inlined
from specshield.rule.values import REGIONS, fill_pose, fill_region
from specshield.task import Task
from specshield.world.regions import PackedRegions


def initial_signals(task: Task) -> Floats:
    """The values that the signals hold before their first samples, shape (S,)."""
    return np.array(list(task.signals.values()), np.float64)


@inlined
def fill_place(regions: PackedRegions, x: float, y: float, theta: float, values: Floats) -> None:
    """The pose and every region; the signals are left as they are."""
    fill_pose(x, y, theta, values)
    for r in range(regions.plain.shape[0]):
        fill_region(regions, r, values)


@inlined
def fill_signals(regions: PackedRegions, signals: Floats, values: Floats) -> None:
    """signals (S,)."""
    copy_row(signals, values[REGIONS + regions.plain.shape[0] :])
