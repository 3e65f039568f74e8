"""The node's messages, made from the classes that `types` gives: those of ROS, or of rosbags in the tests.

`types("nav_msgs/msg/Path")` is a class that takes its fields as keywords; those that are left out have the
defaults of their types, so that the same code makes both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from specshield.drawing.outline import outlines
from specshield.world.regions import Region
from specshield_ros.logic import Told

Types = Callable[[str], Any]
BLUE, GREEN, ORANGE, RED = (0.2, 0.5, 0.9), (0.2, 0.7, 0.3), (0.9, 0.6, 0.1), (0.9, 0.2, 0.2)
LEVELS = {"satisfied": b"\x00", "pending": b"\x00", "violated": b"\x02"}  # DiagnosticStatus OK and ERROR
WARN = b"\x01"
LINE_STRIP, TEXT = 4, 9  # visualization_msgs/Marker


def path_of(types: Types, told: Told, frame: str, stamp: Any) -> Any:
    """The certified continuation: nav_msgs/Path, empty where there is none."""
    posed = types("geometry_msgs/msg/PoseStamped")
    poses = [
        posed(header=_header(types, frame, stamp), pose=_pose(types, *map(float, each)))
        for each in told.ahead
    ]
    return types("nav_msgs/msg/Path")(header=_header(types, frame, stamp), poses=poses)


def markers_of(types: Types, regions: Mapping[str, Region], told: Told, frame: str, stamp: Any) -> Any:
    """The regions of the rule, and how it stands: visualization_msgs/MarkerArray."""
    markers = []
    for name, region in regions.items():
        for i, line in enumerate(outlines(region)):
            points = [_point(types, float(x), float(y)) for x, y in line]
            markers.append(
                _marker(types, frame, stamp, f"region/{name}", i, LINE_STRIP, BLUE, points, "", None)
            )
        x, y = outlines(region)[0][:-1].mean(axis=0)
        at = _pose(types, float(x), float(y), 0.0)
        markers.append(_marker(types, frame, stamp, f"region/{name}", -1, TEXT, BLUE, [], name, at))
    color = {"stop": RED, "witness": ORANGE}.get(told.source, GREEN if told.status != "violated" else RED)
    if len(told.ahead):
        at, text = _pose(types, *map(float, told.ahead[0])), f"{told.status}: {told.name} ({told.source})"
        markers.append(_marker(types, frame, stamp, "verdict", 0, TEXT, color, [], text, at))
    return types("visualization_msgs/msg/MarkerArray")(markers=markers)


def diagnostics_of(types: Types, told: Told, stamp: Any) -> Any:
    """diagnostic_msgs/DiagnosticArray: an error where the rule is broken, a warning where the model is not
    what drives."""
    level = LEVELS[told.status] if told.source == "shield" else max(LEVELS[told.status], WARN)
    pair = types("diagnostic_msgs/msg/KeyValue")
    mass = "" if told.feasible_mass is None else f"{told.feasible_mass:.3f}"
    values = {"source": told.source, "action": told.name, "feasible_mass": mass, "reason": told.reason}
    status = types("diagnostic_msgs/msg/DiagnosticStatus")(
        level=level,
        name="specshield",
        message=f"the rule is {told.status}",
        hardware_id="",
        values=[pair(key=key, value=value) for key, value in values.items()],
    )
    return types("diagnostic_msgs/msg/DiagnosticArray")(header=_header(types, "", stamp), status=[status])


def action_of(types: Types, told: Told) -> Any:
    """std_msgs/Int32: the action to run, -1 where the robot should stand."""
    return types("std_msgs/msg/Int32")(data=-1 if told.action is None else told.action)


def _header(types: Types, frame: str, stamp: Any) -> Any:
    return types("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)


def _point(types: Types, x: float, y: float, z: float = 0.0) -> Any:
    return types("geometry_msgs/msg/Point")(x=x, y=y, z=z)


def _pose(types: Types, x: float, y: float, theta: float) -> Any:
    turned = types("geometry_msgs/msg/Quaternion")(
        x=0.0, y=0.0, z=math.sin(theta / 2.0), w=math.cos(theta / 2.0)
    )
    return types("geometry_msgs/msg/Pose")(position=_point(types, x, y), orientation=turned)


def _marker(
    types: Types,
    frame: str,
    stamp: Any,
    namespace: str,
    id: int,
    kind: int,
    color: tuple[float, float, float],
    points: list[Any],
    text: str,
    pose: Any,
) -> Any:
    """A line 4 cm wide, or text 0.3 m high; it stays until the next."""
    r, g, b = color
    size = 0.3 if kind == TEXT else 0.04
    given = {
        "header": _header(types, frame, stamp),
        "ns": namespace,
        "id": id,
        "type": kind,
        "action": 0,
        "pose": _pose(types, 0.0, 0.0, 0.0) if pose is None else pose,
        "scale": types("geometry_msgs/msg/Vector3")(x=size, y=size, z=size),
        "color": types("std_msgs/msg/ColorRGBA")(r=r, g=g, b=b, a=1.0),
        "points": points,
        "text": text,
    }
    return types("visualization_msgs/msg/Marker")(**given)
