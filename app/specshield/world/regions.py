"""Named areas of the floor, and the signed distance to their boundary: positive inside, in metres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from specshield.arrays import Bools, Floats, Ints
from specshield.compiled import inlined, kernel, leaf
from specshield.errors import MapError
from specshield.world import checks

MAX_VERTICES = 1000  # of a polygon
MAX_MEMBERS = 1000  # of a union
CIRCLE, RECTANGLE, POLYGON = 0, 1, 2

Point = tuple[float, float]


@dataclass(frozen=True)
class Circle:
    """center (x, y) and radius in metres, radius > 0."""

    center: Point
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", checks.numbers(self.center, 2, "center"))
        object.__setattr__(self, "radius", checks.number(self.radius, "radius"))
        if self.radius <= 0:
            raise MapError(
                "a circle's radius has to be positive", path="radius", got=self.radius, expected="> 0"
            )


@dataclass(frozen=True)
class Rectangle:
    """Along the map's axes: lower-left and upper-right corners (x, y) in metres, min < max."""

    min: Point
    max: Point

    def __post_init__(self) -> None:
        object.__setattr__(self, "min", checks.numbers(self.min, 2, "min"))
        object.__setattr__(self, "max", checks.numbers(self.max, 2, "max"))
        if not (self.min[0] < self.max[0] and self.min[1] < self.max[1]):
            told = "a rectangle's min has to be below its max on both axes"
            expected = f"x > {self.min[0]:g} and y > {self.min[1]:g}"
            raise MapError(told, path="max", got=list(self.max), expected=expected)


@dataclass(frozen=True)
class Polygon:
    """At least 3 vertices (x, y) in metres, in either sense of turning. Edges may not touch or cross."""

    vertices: tuple[Point, ...]

    def __post_init__(self) -> None:
        given = checks.items(self.vertices, "vertices", 3, MAX_VERTICES)
        vertices = tuple(checks.numbers(v, 2, f"vertices[{i}]") for i, v in enumerate(given))
        object.__setattr__(self, "vertices", vertices)
        first, second = _crossing_edges(np.array(vertices))
        if first >= 0:
            told = f"the polygon's edges {first} and {second} (counted by first vertex) touch or cross"
            expected = "a simple polygon, no vertex repeated"
            raise MapError(told, path="vertices", got=[first, second], expected=expected)


@dataclass(frozen=True)
class Union:
    """Every point that is inside some member. Its signed distance is the largest of its members'.

    That is exact outside, and inside members that touch no other; where members overlap or touch it is a
    lower bound on the true depth.
    """

    members: tuple[Circle | Rectangle | Polygon, ...]

    def __post_init__(self) -> None:
        checks.items(self.members, "members", 1, MAX_MEMBERS)
        object.__setattr__(self, "members", tuple(self.members))


Region = Circle | Rectangle | Polygon | Union
KINDS = {kind.__name__.lower(): kind for kind in (Circle, Rectangle, Polygon, Union)}


def signed_distance(region: Region, points: ArrayLike) -> Floats:
    """Metres to the region's boundary, positive inside. points [..., 2] in the map frame, result [...]."""
    array = np.asarray(points, dtype=np.float64)
    return area_distance(Area(region), np.concatenate([array, np.zeros((*array.shape[:-1], 1))], axis=-1))


def area_distance(area: Area, poses: ArrayLike) -> Floats:
    """What a formula reads of a region at poses [..., 3] of the robot, in metres: shape [...]."""
    array = np.asarray(poses, dtype=np.float64)
    flat = np.ascontiguousarray(array.reshape(-1, 3))
    result: Floats = _distances(_packed(area), flat).reshape(array.shape[:-1])
    return result


@dataclass(frozen=True)
class Area:
    """What a formula reads of a region: the signed distance of a point that the robot carries, plus `grown`.

    point: metres ahead and to the left of the robot's origin. With the centre of a round footprint and its
    radius, a positive sum says that the footprint touches the region; with minus its radius, that the
    footprint lies inside it.
    """

    region: Region
    grown: float = 0.0
    point: Point = (0.0, 0.0)


class PackedRegions(NamedTuple):
    """Areas as flat arrays for compiled code.

    starts: int64[regions + 1], region i has the parts starts[i]:starts[i + 1].
    kinds: int64[parts], CIRCLE, RECTANGLE or POLYGON.
    offsets: int64[parts + 1], part p has the numbers data[offsets[p]:offsets[p + 1]].
    data: float64, in metres: circle x, y, radius; rectangle xmin, ymin, xmax, ymax; polygon x, y, x, y, ...
    plain [regions]: whether it is the region itself, read at the robot's origin. carried [regions, 3]: the
    point (ahead, left) that the robot carries, and how far the region is grown, as in `Area`, in metres.
    """

    starts: Ints
    kinds: Ints
    offsets: Ints
    data: Floats
    plain: Bools
    carried: Floats


@lru_cache(maxsize=1024)
def _packed(area: Area) -> PackedRegions:
    return pack_areas([area])


def pack_areas(areas: Sequence[Area]) -> PackedRegions:
    starts, kinds, offsets, data = [0], [], [0], list[float]()
    for region in (area.region for area in areas):
        for part in region.members if isinstance(region, Union) else (region,):
            if isinstance(part, Circle):
                kinds.append(CIRCLE)
                data += [*part.center, part.radius]
            elif isinstance(part, Rectangle):
                kinds.append(RECTANGLE)
                data += [*part.min, *part.max]
            else:
                kinds.append(POLYGON)
                data += [c for vertex in part.vertices for c in vertex]
            offsets.append(len(data))
        starts.append(len(kinds))
    return PackedRegions(
        np.array(starts, dtype=np.int64),
        np.array(kinds, dtype=np.int64),
        np.array(offsets, dtype=np.int64),
        np.array(data, dtype=np.float64),
        np.array([area.grown == 0.0 and area.point == (0.0, 0.0) for area in areas], dtype=np.bool_),
        np.array([(*area.point, area.grown) for area in areas], dtype=np.float64).reshape(-1, 3),
    )


@inlined
def turns_with_robot(regions: PackedRegions, i: int) -> bool:
    """Whether what is read of packed region i depends on the robot's heading."""
    return bool(regions.carried[i, 0] != 0.0 or regions.carried[i, 1] != 0.0)


@inlined
def region_distance(regions: PackedRegions, i: int, x: float, y: float, theta: float) -> float:
    """What a formula reads of packed region i at a pose of the robot (`Area`), in metres."""
    grown = 0.0
    if not regions.plain[i]:  # most are, and this is where a decision spends its time
        ahead, left, grown = regions.carried[i, 0], regions.carried[i, 1], regions.carried[i, 2]
        if ahead != 0.0 or left != 0.0:
            cos, sin = math.cos(theta), math.sin(theta)
            x, y = x + ahead * cos - left * sin, y + ahead * sin + left * cos
    return float(_point_distance(regions, i, x, y) + grown)


@inlined
def _point_distance(regions: PackedRegions, i: int, x: float, y: float) -> float:
    """Signed distance of the point (x, y) to packed region i, metres, positive inside."""
    data, best = regions.data, -np.inf
    for part in range(regions.starts[i], regions.starts[i + 1]):
        begin, end, kind = regions.offsets[part], regions.offsets[part + 1], regions.kinds[part]
        if kind == CIRCLE:
            d = data[begin + 2] - math.sqrt((x - data[begin]) ** 2 + (y - data[begin + 1]) ** 2)
        elif kind == RECTANGLE:
            dx = min(x - data[begin], data[begin + 2] - x)
            dy = min(y - data[begin + 1], data[begin + 3] - y)
            d = -math.sqrt(dx * dx + dy * dy) if dx < 0.0 and dy < 0.0 else min(dx, dy)
        else:
            d = _polygon_distance(data, begin, end, x, y)
        best = max(best, d)
    return best


@leaf
def _polygon_distance(data: Floats, begin: int, end: int, x: float, y: float) -> float:
    """The nearest edge gives the size; the sign is positive if a ray to the right crosses an odd number."""
    inside = False
    nearest = np.inf
    x1, y1 = data[end - 2], data[end - 1]
    for k in range(begin, end, 2):
        x2, y2 = data[k], data[k + 1]
        ex, ey = x2 - x1, y2 - y1
        along = ((x - x1) * ex + (y - y1) * ey) / (ex * ex + ey * ey)
        along = min(max(along, 0.0), 1.0)
        dx, dy = x - (x1 + along * ex), y - (y1 + along * ey)
        nearest = min(nearest, dx * dx + dy * dy)
        if (y1 > y) != (y2 > y) and x < x1 + (y - y1) / ey * ex:
            inside = not inside
        x1, y1 = x2, y2
    return math.sqrt(nearest) if inside else -math.sqrt(nearest)


@kernel
def _distances(regions: PackedRegions, poses: Floats) -> Floats:
    out = np.empty(poses.shape[0])
    for k in range(poses.shape[0]):
        out[k] = region_distance(regions, 0, poses[k, 0], poses[k, 1], poses[k, 2])
    return out


@kernel
def _side(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> int:
    """1, 0 or -1: c is left of, on or right of the line from a to b."""
    cross = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    return (cross > 0.0) - (cross < 0.0)


@kernel
def _crossing_edges(v: Floats) -> tuple[int, int]:
    """The first two edges of a polygon v (n, 2) that share a point they should not, or (-1, -1)."""
    n = v.shape[0]
    for i in range(n):
        a, b = v[i], v[(i + 1) % n]
        if a[0] == b[0] and a[1] == b[1]:
            return i, (i + 1) % n
        for j in range(i + 1, n):
            c, d = v[j], v[(j + 1) % n]
            abc, abd = _side(a[0], a[1], b[0], b[1], c[0], c[1]), _side(a[0], a[1], b[0], b[1], d[0], d[1])
            cda, cdb = _side(c[0], c[1], d[0], d[1], a[0], a[1]), _side(c[0], c[1], d[0], d[1], b[0], b[1])
            if j == i + 1 or j - i == n - 1:  # neighbours share a vertex: wrong only if one folds back
                back = (b[0] - a[0]) * (d[0] - c[0]) + (b[1] - a[1]) * (d[1] - c[1]) < 0.0
                if abc == 0 and abd == 0 and back:
                    return i, j
                continue
            apart = (
                max(a[0], b[0]) < min(c[0], d[0])
                or max(c[0], d[0]) < min(a[0], b[0])
                or max(a[1], b[1]) < min(c[1], d[1])
                or max(c[1], d[1]) < min(a[1], b[1])
            )
            if not apart and abc * abd <= 0 and cda * cdb <= 0:
                return i, j
    return -1, -1


def region_from_json(spec: Any, path: str, whole: bool = True) -> Region:
    """A region of the HTTP contract; MapError with the member's path below `path`. whole: whether it is no
    member of a union, and so may be a union itself.

    {"type": "circle", "center": [x, y], "radius"}, {"type": "rectangle", "min": [x, y], "max": [x, y]},
    {"type": "polygon", "vertices": [[x, y], ...]}, {"type": "union", "members": [the others, ...]}.
    """
    spec = checks.mapping(spec, path)
    kind = checks.member(spec, "type", path)
    if not isinstance(kind, str) or kind not in KINDS:
        raise checks.wrong("kind of region", f"{path}.type", kind, "one of " + ", ".join(KINDS))
    if kind == "union" and not whole:
        told, expected = "a union cannot be a member of a union", "circle, rectangle or polygon"
        raise MapError(told, path=path, got=kind, expected=expected)
    names = [field.name for field in fields(KINDS[kind])]
    if extra := sorted(set(map(str, spec)) - {"type", *names}):
        told, expected = f"a {kind} has no member {extra[0]!r}", "type, " + ", ".join(names)
        raise MapError(told, path=f"{path}.{extra[0]}", got=extra[0], expected=expected)
    values = [checks.member(spec, name, path) for name in names]
    if kind == "union":
        where = f"{path}.members"
        given = checks.items(values[0], where, 1, MAX_MEMBERS)
        values = [[region_from_json(each, f"{where}[{i}]", False) for i, each in enumerate(given)]]
    try:
        return KINDS[kind](*values)
    except MapError as error:
        raise error.at(path) from None


def region_to_json(region: Region) -> dict[str, Any]:
    """The JSON that region_from_json reads back as an equal region."""
    if isinstance(region, Circle):
        return {"type": "circle", "center": list(region.center), "radius": region.radius}
    if isinstance(region, Rectangle):
        return {"type": "rectangle", "min": list(region.min), "max": list(region.max)}
    if isinstance(region, Polygon):
        return {"type": "polygon", "vertices": [list(vertex) for vertex in region.vertices]}
    return {"type": "union", "members": [region_to_json(member) for member in region.members]}
