"""ProcTHOR houses as occupancy grids: the map's (x, y) is the house's (x, z), theta = pi/2 - yaw.

A cell is occupied if it lies in no room, or touches a wall or a fixed thing that stands on the floor. Things
that hang higher than STANDS_BELOW are left out, and so are things that are not fixed (`kinematic: false`),
since those get moved.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats
from specshield.errors import MapError
from specshield.world import checks
from specshield.world.formats import MapFormat
from specshield.world.occupancy import OccupancyGrid, check_size
from specshield.world.regions import Polygon, Region, Union, signed_distance

STANDS_BELOW = 0.3  # [m] a fixed thing whose lowest point is higher hangs on a wall or stands on another
TOUCH = 1e-9  # [m] things that come this near touch
MAX_ITEMS = 10_000  # of one list, so that hostile JSON ends early


def load_house(house: Any, asset_sizes: Any, resolution: float) -> tuple[OccupancyGrid, dict[str, Region]]:
    """(grid, rooms) of a ProcTHOR house.

    asset_sizes: the full extents in metres of every object's and child's asset, by assetId: [x, y, z] or
    {"x": x, "y": y, "z": z}, either of them also as the member `size` or `boundingBox` of an object.
    rooms: polygons named by roomType; where a type comes twice, Bedroom_1, Bedroom_2 and Bedroom, their
    union. MapError names an unknown asset, a missing member or a number that cannot be.
    """
    resolution = checks.number(resolution, "resolution", 1e-4, 100.0)
    polygons = _polygons(house)
    corners = np.array([vertex for _, polygon in polygons for vertex in polygon.vertices])
    low = np.floor(corners.min(axis=0) / resolution) - 1
    width, height = (int(n) for n in np.ceil(corners.max(axis=0) / resolution) + 1 - low)
    check_size(width, height)
    canvas = _Canvas(np.ones((height, width), bool), resolution, low * resolution)
    for _, polygon in polygons:
        outline = np.array(polygon.vertices)
        window, centres = canvas.window(outline.min(axis=0), outline.max(axis=0))
        window &= signed_distance(polygon, centres) < -TOUCH
    for first, second in _walls(house):
        canvas.cover((first + second) / 2, ((second - first) / 2)[None])
    for centre, spans in _furniture(house, asset_sizes):
        canvas.cover(centre, spans)
    return OccupancyGrid(canvas.occupied, resolution, (*canvas.corner, 0.0)), _rooms(polygons)


def _polygons(house: Any) -> list[tuple[str, Polygon]]:
    """(roomType, outline) of each room."""
    found = []
    for path, room in _items(house, "rooms", low=1):
        kind = checks.text(checks.member(room, "roomType", path), f"{path}.roomType")
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9]{0,63}", kind):
            raise checks.wrong("name", f"{path}.roomType", kind, "letters a to z and digits, a letter first")
        outline = [(x, z) for x, _, z in _points(room, "floorPolygon", path, 3)]
        try:
            found.append((kind, Polygon(tuple(outline))))
        except MapError as error:
            raise error.at(f"{path}.floorPolygon") from None
    return found


def _rooms(polygons: list[tuple[str, Polygon]]) -> dict[str, Region]:
    rooms: dict[str, Region] = {}
    for kind in dict.fromkeys(kind for kind, _ in polygons):
        members = [polygon for other, polygon in polygons if other == kind]
        if len(members) > 1:
            rooms |= {f"{kind}_{i}": polygon for i, polygon in enumerate(members, start=1)}
            rooms[kind] = Union(tuple(members))
        else:
            rooms[kind] = members[0]
    return rooms


def _walls(house: Any) -> Iterator[tuple[Floats, Floats]]:
    """The two ends [2] of each straight piece of wall that is left when the doorways are cut out."""
    walls: dict[str, tuple[Floats, Floats]] = {}
    open_plan: set[str] = set()
    for path, wall in _items(house, "walls"):
        ends = [np.array([x, z]) for x, _, z in _points(wall, "polygon", path, 2)]
        identity = checks.text(checks.member(wall, "id", path), f"{path}.id")
        if identity in walls:
            raise checks.wrong("name", f"{path}.id", identity, "an id that no other wall of this house has")
        walls[identity] = ends[0], ends[1]
        if wall.get("empty") is True:
            open_plan.add(identity)
    gaps: dict[str, list[tuple[Floats, Floats]]] = {}
    for path, door in _items(house, "doors"):
        first, second = (checks.member(door, key, path) for key in ("wall0", "wall1"))
        for key, identity in (("wall0", first), ("wall1", second)):
            if checks.text(identity, f"{path}.{key}") not in walls:
                raise checks.wrong("wall", f"{path}.{key}", identity, "the id of a wall of this house")
        if _passable(door, path, (first, second)):
            start, end = walls[first]
            along = (end - start) / max(float(np.linalg.norm(end - start)), TOUCH)
            hole = [x for x, _, _ in _points(door, "holePolygon", path, 2)]
            for identity in (first, second):
                gaps.setdefault(identity, []).append((start + hole[0] * along, start + hole[1] * along))
    for identity, (start, end) in walls.items():
        if identity not in open_plan:
            yield from _pieces(start, end, gaps.get(identity, []))


def _passable(door: Mapping[str, Any], path: str, walls: tuple[str, str]) -> bool:
    """Whether a robot can pass: an inner door that stands fully open, or a frame without `openness`.

    Outer doors, and doors that lead back to their own room, count as closed.
    """
    inner = checks.member(door, "room0", path) != checks.member(door, "room1", path)
    if not inner or any(wall.startswith("wall|exterior") for wall in walls):
        return False
    openness = door.get("openness")
    return openness is None or checks.number(openness, f"{path}.openness") >= 1.0


def _pieces(start: Floats, end: Floats, gaps: list[tuple[Floats, Floats]]) -> Iterator[tuple[Floats, Floats]]:
    """The segment from start to end without the gaps on it."""
    length = float(np.linalg.norm(end - start))
    if length < TOUCH:
        yield start, end
        return
    along = (end - start) / length
    done = 0.0
    for low, high in sorted(
        sorted((float((p - start) @ along), float((q - start) @ along))) for p, q in gaps
    ):
        if low > done:
            yield start + done * along, start + min(low, length) * along
        done = max(done, high)
    if done < length:
        yield start + done * along, end


def _furniture(house: Any, asset_sizes: Any) -> Iterator[tuple[Floats, Floats]]:
    """Centre [2] and half edges [3, 2] on the floor plane of each fixed thing that stands on the floor."""
    sizes = checks.mapping(asset_sizes, "asset_sizes")
    pending = list(_items(house, "objects"))
    for path, thing in pending:  # grows by the children
        if len(pending) > MAX_ITEMS:
            raise checks.wrong("list", "objects", len(pending), f"at most {MAX_ITEMS} objects")
        pending += _items(thing, "children", path) if "children" in thing else []
        asset = checks.text(checks.member(thing, "assetId", path), f"{path}.assetId")
        if asset not in sizes:
            told = f"{path} has the asset {asset!r}, which asset_sizes does not have"
            expected = "a key of asset_sizes"
            raise MapError(told, path=f"{path}.assetId", got=checks.shown(asset), expected=expected)
        half = np.array(_size(sizes[asset], f"asset_sizes.{asset}")) / 2
        x, y, z = _vector(checks.member(thing, "position", path), f"{path}.position")
        degrees = _vector(checks.member(thing, "rotation", path), f"{path}.rotation")
        edges = half[:, None] * _rotation(degrees).T
        lowest = y - np.abs(edges[:, 1]).sum()
        fixed = checks.member(thing, "kinematic", path)
        if not isinstance(fixed, bool):
            raise checks.wrong("flag", f"{path}.kinematic", fixed, "true or false")
        if fixed and lowest < STANDS_BELOW:
            yield np.array([x, z]), edges[:, [0, 2]]


def _size(value: Any, path: str) -> list[float]:
    """The extents [m] along x, y and z, in any of the forms that `load_house` takes."""
    for key in ("size", "boundingBox"):
        if isinstance(value, Mapping) and key in value:
            value, path = value[key], f"{path}.{key}"
    if isinstance(value, Mapping):
        return [
            checks.number(checks.member(value, axis, path), f"{path}.{axis}", 0.0, 1000.0) for axis in "xyz"
        ]
    extents = checks.items(value, path, 3, 3)
    return [checks.number(extent, f"{path}[{i}]", 0.0, 1000.0) for i, extent in enumerate(extents)]


def _rotation(degrees: tuple[float, float, float]) -> Floats:
    """Unity's rotation matrix [3, 3]: about z, then x, then y."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(about_y @ about_x @ about_z)


class _Canvas(NamedTuple):
    """The cells while they are drawn: bool[height, width], resolution [m], lower left corner (x, y)."""

    occupied: Bools
    resolution: float
    corner: Floats

    def window(self, low: Floats, high: Floats) -> tuple[Bools, Floats]:
        """A view of the cells [h, w] that touch a rectangle, and their centres [h, w, 2]."""
        size = self.occupied.shape[::-1]
        j0, i0 = np.clip(np.floor((low - TOUCH - self.corner) / self.resolution), 0, size).astype(int)
        j1, i1 = np.clip(np.ceil((high + TOUCH - self.corner) / self.resolution), 0, size).astype(int)
        columns, rows = np.meshgrid(np.arange(j0, j1) + 0.5, np.arange(i0, i1) + 0.5)
        return self.occupied[i0:i1, j0:j1], self.corner + np.stack([columns, rows], axis=-1) * self.resolution

    def cover(self, centre: Floats, spans: Floats) -> None:
        """Occupies the cells that touch {centre + sum of t_k spans[k], |t_k| <= 1}, spans [k, 2].

        That set is a segment or a box's shadow. Two convex shapes are apart exactly when the normal of some
        edge separates them (separating axes).
        """
        reach = np.abs(spans).sum(axis=0)
        window, centres = self.window(centre - reach, centre + reach)
        touches = np.ones(window.shape, bool)
        for along_x, along_y in spans:
            normal = np.array([-along_y, along_x])
            limit = np.abs(spans @ normal).sum() + self.resolution / 2 * np.abs(normal).sum()
            touches &= np.abs((centres - centre) @ normal) <= limit + TOUCH * np.linalg.norm(normal)
        window |= touches


def _items(parent: Any, key: str, path: str = "", low: int = 0) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """(path, object) of each item of the list parent[key]."""
    where = f"{path}.{key}" if path else key
    for i, item in enumerate(checks.items(checks.member(parent, key, path), where, low, MAX_ITEMS)):
        yield f"{where}[{i}]", checks.mapping(item, f"{where}[{i}]")


def _points(parent: Mapping[str, Any], key: str, path: str, low: int) -> list[tuple[float, float, float]]:
    return [_vector(point, where) for where, point in _items(parent, key, path, low)]


def _vector(value: Any, path: str) -> tuple[float, float, float]:
    x, y, z = (checks.number(checks.member(value, axis, path), f"{path}.{axis}") for axis in "xyz")
    return x, y, z


def _parse(house: Any, asset_sizes: Any, resolution: Any) -> tuple[OccupancyGrid, dict[str, Region]]:
    checks.mapping(house, "house")
    try:
        return load_house(house, asset_sizes, resolution)
    except MapError as error:
        below = (error.path or "").startswith(("asset_sizes", "resolution"))
        raise error if below else error.at("house") from None


FORMAT = MapFormat(
    "A ProcTHOR house. Map (x, y) is the house's (x, z) in metres; theta = pi/2 - yaw. Its rooms are names.",
    {
        "house": {"type": "object", "description": "The house's JSON."},
        "asset_sizes": {
            "type": "object",
            "description": "Bounding box of every asset it uses, by asset id: `[x, y, z]` or "
            '`{"x": x, "y": y, "z": z}` in metres, or an object that has this as `size` or `boundingBox`.',
        },
        "resolution": {
            "type": "number", "minimum": 1e-4, "maximum": 100, "default": 0.05,
            "description": "Side of a cell [m].",
        },
    },
    _parse,
)  # fmt: skip
