"""What a formula's predicates read at one state, as one array: the pose, the regions, the signals.

`values` holds x, y [m] and theta [rad], then what the task reads of each of its R areas [m], then
each of its S signals. Programs (stl/program.py) name what they read by its place in this array. Everything
that evaluates predicates fills it here, so that the places mean the same to all.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from specshield.arrays import Floats
from specshield.compiled import inlined
from specshield.task import POSE_NAMES, Task
from specshield.world.regions import PackedRegions, pack_areas, region_distance

HEADING = POSE_NAMES.index("theta")
REGIONS = len(POSE_NAMES)  # the place of the first region


def places(task: Task) -> dict[str, int]:
    """The place of every name that the task's formula may use."""
    return {name: i for i, name in enumerate([*POSE_NAMES, *task.areas, *task.signals])}


def regions_of(task: Task) -> PackedRegions:
    """The task's areas in the order of their places."""
    return pack_areas(list(task.areas.values()))


def signal_rows(task: Task, signals: Mapping[str, Floats], n: int) -> Floats:
    """The signals' first n samples in the order of the task, shape (n, S). signals {name: [..n]}."""
    rows = np.empty((n, len(task.signals)))
    for i, name in enumerate(task.signals):
        rows[:, i] = task.signal(name, signals, n)
    return rows


@inlined
def fill_pose(x: float, y: float, theta: float, values: Floats) -> None:
    values[0], values[1], values[2] = x, y, theta


@inlined
def fill_region(regions: PackedRegions, r: int, values: Floats) -> None:
    """What is read of area r at the pose in `values`. Formulas often need only some: they cost the most."""
    # The heading is not a parameter: LLVM would then take its cosine before each loop over the areas, also
    # where none of them turns with the robot, which took a third of the time in which futures are judged.
    values[REGIONS + r] = region_distance(regions, r, values[0], values[1], values[HEADING])
