"""Warnings about input that is accepted but looks like a mistake: degrees, a place off the map, a jump."""

from __future__ import annotations

import math
from collections.abc import Iterator

from specshield.arrays import Floats
from specshield.robot.dynamics import Body, longest_motions
from specshield.world.occupancy import OccupancyGrid

FULL_TURN = 2.0 * math.pi + 1e-6  # [rad] no convention for headings goes beyond it
JUMP = 1.0  # [m] beyond the longest motion: more than robots slip. Chosen by hand


def oddities(grid: OccupancyGrid, body: Body, poses: Floats) -> Iterator[str]:
    """What looks odd about x_t, one sentence each. poses [t + 1, 3]: as sent, headings not wrapped."""
    x, y, theta = poses[-1].tolist()
    if abs(theta) > FULL_TURN:
        meant = math.radians(theta)
        yield f"theta is in radians, and {theta:g} looks like degrees, which would be {meant:.4g} radians"
    low_x, low_y, high_x, high_y = grid.bounds
    if not (low_x <= x <= high_x and low_y <= y <= high_y):
        spans = f"({low_x:g}, {low_y:g}) to ({high_x:g}, {high_y:g})"
        yield f"the pose ({x:g}, {y:g}) is off the map, which spans {spans} in metres"
    if len(poses) > 1:
        last_x, last_y, _ = poses[-2].tolist()
        moved = math.hypot(x - last_x, y - last_y)
        if moved > JUMP and moved > (most := longest_motions(body)[0]) + JUMP:
            yield f"the pose is {moved:.3g} m from the one before; the robot's longest motion is {most:g} m"
