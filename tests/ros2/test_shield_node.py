"""The ROS 2 node without ROS: its logic, and its messages against the definitions that rosbags brings.

Not run here: the launch file and most of node.py, which need rclpy. They are compiled, and what they name is
there.
"""

from __future__ import annotations

import ast
import math
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml

PACKAGE = Path(__file__).parents[2] / "ros2" / "specshield_ros"
sys.path.insert(0, str(PACKAGE))
typesys = pytest.importorskip("rosbags.typesys")

from specshield_ros import messages  # noqa: E402
from specshield_ros.logic import Logic, Pose, yaw_of  # noqa: E402

from specshield.errors import SpecshieldError  # noqa: E402

STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
PARAMETERS = yaml.safe_load((PACKAGE / "config" / "shield.yaml").read_text())["shield"]["ros__parameters"]


def default(kind: tuple[int, Any]) -> Any:
    """What a field holds that nobody sets. kind: rosbags' description of it."""
    node, about = int(kind[0]), kind[1]
    if node == 1:  # a number, a truth value or a text
        return {"string": "", "bool": False}.get(about[0], 0.0 if about[0].startswith("float") else 0)
    if node == 2:  # a message
        return types(about)()
    inner = about[0]
    return np.zeros(0, inner[1][0]) if int(inner[0]) == 1 and inner[1][0] != "string" else []


def types(name: str) -> Callable[..., Any]:
    """The class of rosbags, which wants every field."""

    def make(**given: Any) -> Any:
        _, known = STORE.fielddefs[name]
        assert given.keys() <= {field for field, _ in known}, name
        values = {field: given[field] if field in given else default(kind) for field, kind in known}
        if name == "diagnostic_msgs/msg/DiagnosticStatus":
            values["level"] = values["level"][0]  # ROS has one byte here, rosbags a number
        return STORE.types[name](**values)

    return make


def there_and_back(message: Any, name: str) -> Any:
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, name), name)


def stamp() -> Any:
    return types("builtin_interfaces/msg/Time")(sec=3, nanosec=5)


def a_map() -> Any:
    """6 x 5 m, walls around."""
    cells = np.zeros((100, 120), np.int8)
    cells[[0, -1], :] = cells[:, [0, -1]] = 100
    info = types("nav_msgs/msg/MapMetaData")(resolution=np.float32(0.05), width=120, height=100)
    info.origin.orientation.w = 1.0
    message = types("nav_msgs/msg/OccupancyGrid")(info=info, data=cells.reshape(-1))
    return there_and_back(message, "nav_msgs/msg/OccupancyGrid")


@pytest.fixture(scope="module")
def made() -> Logic:
    logic = Logic(PARAMETERS["rule"], PARAMETERS["regions"], PARAMETERS["robot"])
    assert logic.on_map(a_map())
    return logic


@pytest.fixture
def logic(made: Logic) -> Logic:
    """A new session on the map, whose policy is made once."""
    made.session, made._plan, made._leads = None, [], None
    return made


START: Pose = (5.0, 1.0, 0.0)


def test_the_parameters_of_the_package_keep_their_rule(logic: Logic) -> None:
    random, pose, statuses = np.random.default_rng(0), START, []
    for _ in range(151):
        told = logic.on_logits(pose, random.normal(size=4).tolist())
        statuses.append(told.status)
        assert told.source == "shield"
        pose = tuple(told.ahead[1])
    assert statuses[:-1] == ["pending"] * 150
    assert statuses[-1] == "satisfied"
    assert not logic.on_map(a_map())  # the same map again changes nothing


def test_a_silent_model_leaves_the_robot_on_the_certified_way(logic: Logic) -> None:
    pose = START
    for _ in range(3):
        pose = tuple(logic.on_logits(pose, [0.0, 1.0, 0.0, 0.0]).ahead[1])
    nearest = math.inf
    for _ in range(117):
        told = logic.silent(pose)
        assert (told.source, told.status) == ("witness", "pending")
        pose = tuple(told.ahead[1])
        nearest = min(nearest, math.dist(pose[:2], (1.0, 1.0)))
    assert nearest < 0.5  # the dock, within its 120 steps
    assert logic.on_logits(pose, [0.0] * 4).status == "pending"  # and the model may go on


def test_a_robot_off_the_way_is_told_to_stand(logic: Logic) -> None:
    x, y, theta = logic.on_logits(START, [0.0] * 4).ahead[1]
    told = logic.silent((x + 0.3, y, theta))
    assert (told.action, told.source) == (None, "stop")
    assert messages.action_of(types, told).data == -1
    assert logic.silent((x, y, theta)).source == "witness"


def test_a_rule_begins_where_the_robot_is_at_the_first_logits_that_can_be_read(logic: Logic) -> None:
    with pytest.raises(SpecshieldError, match="number of logits"):
        logic.on_logits(START, [0.0])
    x, y, theta = START
    assert logic.on_logits((x + 0.01, y, theta), [0.0] * 4).source == "shield"


def test_without_a_map_it_says_so() -> None:
    with pytest.raises(SpecshieldError, match="no map"):
        Logic("F[0,9] x > 1", "{}", PARAMETERS["robot"]).on_logits(START, [0.0] * 4)


@pytest.mark.parametrize(
    ("regions", "robot", "named"),
    [("{", "{}", "regions"), ("[]", "{}", "regions"), ("{}", "stretch", "robot"), ("{}", "[1]", "robot")],
)
def test_parameters_that_cannot_be_read_are_named(regions: str, robot: str, named: str) -> None:
    with pytest.raises(SpecshieldError) as refused:
        Logic("F[0,9] x > 1", regions, robot)
    assert refused.value.path == named


def test_logits_that_cannot_be_read_do_not_count_against_patience(
    logic: Logic, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The timer of `patience` seconds begins anew with a decision alone, so that the witness runs."""
    tree = ast.parse((PACKAGE / "specshield_ros" / "node.py").read_text())
    for name in {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}:
        for part in (name.split(".")[0], name):
            if part not in sys.modules:
                monkeypatch.setitem(sys.modules, part, MagicMock(Node=object))
    on_logits = import_module("specshield_ros.node").ShieldNode.on_logits
    node: Any = MagicMock(logic=logic, pose=lambda: START)
    for data in ([0.0] * 3, [math.nan] * 4, [0.0] * 4):
        assert not node.timer.reset.called
        assert not node.tell.called
        on_logits(node, SimpleNamespace(data=data))
    node.timer.reset.assert_called_once()
    assert node.tell.call_args.args[0].source == "shield"


def test_its_messages_are_those_of_ros(logic: Logic) -> None:
    """Each is written as CDR by the real definition, and read back."""
    told = logic.on_logits(START, [0.0, -1.0, 2.0, 0.5])
    path = there_and_back(messages.path_of(types, told, "map", stamp()), "nav_msgs/msg/Path")
    assert (path.header.frame_id, path.header.stamp.sec) == ("map", 3)
    read = [(p.pose.position.x, p.pose.position.y, yaw_of(p.pose.orientation)) for p in path.poses]
    assert np.cos(np.array(read)) == pytest.approx(np.cos(told.ahead))
    assert logic.shield is not None
    marked = messages.markers_of(types, logic.shield.task.regions, told, "map", stamp())
    marked = there_and_back(marked, "visualization_msgs/msg/MarkerArray")
    assert {m.ns for m in marked.markers} == {"region/Dock", "region/Stairs", "verdict"}
    kind = STORE.types["visualization_msgs/msg/Marker"]
    assert {m.type for m in marked.markers} == {kind.LINE_STRIP, kind.TEXT_VIEW_FACING}
    (verdict,) = (m for m in marked.markers if m.ns == "verdict")
    assert verdict.text == f"pending: {told.name} (shield)"
    said = there_and_back(
        messages.diagnostics_of(types, told, stamp()), "diagnostic_msgs/msg/DiagnosticArray"
    )
    assert said.status[0].level == STORE.types["diagnostic_msgs/msg/DiagnosticStatus"].OK
    assert {v.key: v.value for v in said.status[0].values}["action"] == told.name
    silent = logic.silent(tuple(told.ahead[1]))
    assert messages.diagnostics_of(types, silent, stamp()).status[0].level == 1
    chosen = there_and_back(messages.action_of(types, told), "std_msgs/msg/Int32")
    assert chosen.data == told.action


def test_what_the_package_needs_is_declared() -> None:
    """Every ROS package that a module imports is in package.xml, and every message it names is a message."""
    manifest = (PACKAGE / "package.xml").read_text()
    for file in (PACKAGE / "specshield_ros" / "node.py", PACKAGE / "launch" / "shield.launch.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if not isinstance(node, ast.ImportFrom) or node.module is None:
                continue
            package, _, kind = node.module.partition(".")
            if kind == "msg":
                assert f"<exec_depend>{package}</exec_depend>" in manifest
                assert all(f"{package}/msg/{each.name}" in STORE.types for each in node.names)
