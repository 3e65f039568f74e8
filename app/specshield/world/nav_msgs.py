"""Maps as ROS's messages have them: nav_msgs/OccupancyGrid as JSON."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from specshield.errors import MapError
from specshield.world import checks
from specshield.world.formats import MapFormat
from specshield.world.map_server import UNKNOWN, from_values
from specshield.world.occupancy import MAX_SIDE, OccupancyGrid


def from_occupancy_grid(info: Any, data: Any) -> OccupancyGrid:
    """nav_msgs/OccupancyGrid: its `info` as an object, its `data` as a flat list, row 0 the lowest y."""
    width, height = (
        checks.integer(checks.member(info, key, "info"), f"info.{key}", 1, MAX_SIDE)
        for key in ("width", "height")
    )
    resolution = checks.number(checks.member(info, "resolution", "info"), "info.resolution", 1e-4, 100.0)
    origin = checks.member(info, "origin", "info")
    position = checks.member(origin, "position", "info.origin")
    x, y = (
        checks.number(checks.member(position, key, "info.origin.position"), f"info.origin.position.{key}")
        for key in "xy"
    )
    yaw = _yaw(checks.member(origin, "orientation", "info.origin"))
    if isinstance(data, list) and data[-1:] == ["..."]:
        told, expected = "the cells were cut off", "all cells, as `ros2 topic echo --full-length` writes them"
        raise MapError(told, path="data", got=checks.shown(data), expected=expected)
    checks.items(data, "data", width * height, width * height)
    if set(map(type, data)) != {int} or not UNKNOWN <= min(data) <= max(data) <= 100:
        i = next(i for i, v in enumerate(data) if type(v) is not int or not UNKNOWN <= v <= 100)
        raise checks.wrong("occupancy", f"data[{i}]", data[i], "an integer from -1 (unknown) to 100")
    return from_values(np.array(data).reshape(height, width), resolution, (x, y, yaw))


def _yaw(orientation: Any) -> float:
    """The yaw of a unit quaternion about z."""
    path = "info.origin.orientation"
    x, y, z, w = (checks.number(checks.member(orientation, k, path), f"{path}.{k}") for k in "xyzw")
    if abs(x * x + y * y + z * z + w * w - 1) > 1e-3 or math.hypot(x, y) > 1e-3:
        told, expected = "a map can be turned about z only", "a unit quaternion, x = y = 0"
        raise MapError(told, path=path, got=[x, y, z, w], expected=expected)
    return 2 * math.atan2(z, w)


FORMAT = MapFormat(
    "A nav_msgs/OccupancyGrid. Unknown cells (-1) count as occupied, and so does all outside the map.",
    {
        "info": {
            "type": "object",
            "required": ["resolution", "width", "height", "origin"],
            "description": "`resolution` [m], `width`, `height` [cells], `origin`: {position, orientation}.",
        },
        "data": {
            "type": "array",
            "items": {"type": "integer", "minimum": UNKNOWN, "maximum": 100},
            "description": "Row-major from the lowest y: -1 unknown, 0..100 occupancy [%].",
        },
    },
    lambda info, data: (from_occupancy_grid(info, data), {}),
    example={
        "info": {
            "resolution": 1.0,
            "width": 5,
            "height": 4,
            "origin": {
                "position": {"x": 0.0, "y": 0.0, "z": 0.0},
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            },
        },
        "data": [0] * 12 + [100, -1] + [0] * 6,
    },
)
