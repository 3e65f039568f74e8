"""The lines of a picture: the outlines of regions, and the way ahead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from specshield.arrays import Floats
from specshield.robot import Robot
from specshield.robot.dynamics import make_body, step
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Circle, Polygon, Rectangle, Region, Union

CORNERS = 48  # of the polygon that is drawn for a circle


def outlines(region: Region) -> list[Floats]:
    """Closed lines [n, 2], one for each part of the region; the last point is the first."""
    match region:
        case Union():
            return [line for part in region.members for line in outlines(part)]
        case Circle():
            turn = np.linspace(0.0, 2.0 * np.pi, CORNERS + 1)
            return [np.array(region.center) + region.radius * np.column_stack([np.cos(turn), np.sin(turn)])]
        case Rectangle():
            (x0, y0), (x1, y1) = region.min, region.max
            return [np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)])]
        case Polygon():
            return [np.array([*region.vertices, region.vertices[0]])]


def way_ahead(
    grid: OccupancyGrid,
    robot: Robot,
    pose: tuple[float, float, float],
    action: int,
    completion: int | None,
    witness: Sequence[int] | None,
) -> Floats:
    """The certified continuation of a decision as poses [n, 3], the first of them `pose`, x_t, which is the
    only one if there is no continuation. action, completion, witness: members of the answer.
    """
    chosen, poses = completion if robot.terminal[action] else action, [pose]
    if witness is not None and chosen is not None:
        body = make_body(robot, grid)
        for motion in robot.motion_of[[chosen, *witness]].tolist():
            if motion >= 0:
                poses.append(step(body, *poses[-1], motion))
    return np.array(poses)
