"""Regions as lines to draw."""

from __future__ import annotations

import numpy as np

from specshield.arrays import Floats
from specshield.world.regions import Circle, Polygon, Rectangle, Region, Union

CORNERS = 48  # of the polygon that a circle is drawn as


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
