"""Keep-outs with smaller regions, for a rule that cannot be kept with the regions as they are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from specshield.errors import MapError
from specshield.stl import Always, Atom, Formula, Not, Until, conjuncts, region_named
from specshield.stl.conjunction import is_predicate
from specshield.world.regions import (
    Area,
    Circle,
    Polygon,
    Rectangle,
    Region,
    Union,
    pack_areas,
    signed_distance,
)

STEP = 0.01  # [m] by multiples of which regions are made smaller
MOST_STEPS = 1_000  # that are tried. Both chosen by hand
MOST_NUMBERS = 2_000  # that describe the regions of a keep-out: as many as the largest polygon has
DIGITS = 6  # of coordinates and radii [m]
PARALLEL = 1e-9  # two edges whose directions have a smaller cross product


def kept_out(part: Formula, regions: Mapping[str, Region]) -> tuple[str, ...]:
    """The regions that a conjunct keeps the robot out of: `G[a,b] not R`, `not R U[a,b] p`, or `not R` alone,
    with several of them too. Empty if to make them smaller would take long.
    """
    asked = part.child if isinstance(part, Always) else part.left if isinstance(part, Until) else part
    barred = [each.child for each in conjuncts(asked) if isinstance(each, Not)] if is_predicate(asked) else []
    names = (region_named(each.name)[1] for each in barred if isinstance(each, Atom))
    found = tuple(dict.fromkeys(name for name in names if name in regions))
    return found if pack_areas([Area(regions[name]) for name in found]).data.size <= MOST_NUMBERS else ()


def most_steps(region: Region) -> int:
    """By how many steps a region can be made smaller."""
    low, high = 0, MOST_STEPS + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if smaller(region, middle) is None else (middle, high)
    return low


def smaller(region: Region, steps: int) -> Region | None:
    """The region with every edge moved inwards by so many steps; None where nothing is left."""
    by = STEP * steps
    match region:
        case Circle(center, radius):
            left = round(radius - by, DIGITS)
            return Circle(center, left) if left > 0.0 else None
        case Rectangle(low, high):
            low = round(low[0] + by, DIGITS), round(low[1] + by, DIGITS)
            high = round(high[0] - by, DIGITS), round(high[1] - by, DIGITS)
            return Rectangle(low, high) if low[0] < high[0] and low[1] < high[1] else None
        case Polygon():
            return _polygon(region, by)
        case Union(members):
            parts = [each for each in (smaller(member, steps) for member in members) if each is not None]
            return Union(tuple(each for each in parts if not isinstance(each, Union))) if parts else None


def _polygon(polygon: Polygon, by: float) -> Polygon | None:
    """The polygon between the edges' lines, each moved inwards. An edge without length is left out."""
    corners = np.array(polygon.vertices)
    ahead = np.roll(corners, -1, axis=0) - corners
    ahead /= np.hypot(ahead[:, 0], ahead[:, 1])[:, None]
    x, y = corners.T
    turns = np.sign((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())  # 1: counter-clockwise
    inward = turns * np.column_stack([-ahead[:, 1], ahead[:, 0]])
    lines = np.column_stack([ahead, inward, (inward * corners).sum(axis=1) + by])
    while len(lines) > 2:
        (_, _, a, b, c), (ax, ay, u, v, w) = np.roll(lines, 1, axis=0).T, lines.T
        cross = a * v - b * u
        if (abs(cross) < PARALLEL).any():
            lines = np.delete(lines, int(np.argmin(abs(cross))), axis=0)
            continue
        corners = np.column_stack([c * v - b * w, a * w - c * u]) / cross[:, None]
        lengths = ((np.roll(corners, -1, axis=0) - corners) * np.column_stack([ax, ay])).sum(axis=1)
        if lengths.min() > 0.0:
            try:
                found = Polygon(tuple((round(x, DIGITS), round(y, DIGITS)) for x, y in corners.tolist()))
            except MapError:
                return None
            around = signed_distance(polygon, corners), -signed_distance(found, polygon.vertices)
            return found if min(each.min() for each in around) > by - STEP / 10 else None
        lines = np.delete(lines, int(np.argmin(lengths)), axis=0)
    return None
