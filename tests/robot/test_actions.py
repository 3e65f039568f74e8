"""Action sets: the Stretch preset, robots from JSON, and what is refused."""

from __future__ import annotations

import json
import math

import pytest

from specshield.errors import RobotError
from specshield.robot import STRETCH, robot_from_json, robot_to_json

CUSTOM = {
    "footprint": {"radius": 0.3, "offset": [0.1, -0.2]},
    "on_contact": "stop",
    "actions": [
        {"name": "forward", "translate": 0.25},
        {"name": "left", "rotate": 0.5},
        {"name": "wait"},
        {"name": "blink"},
        {"name": "end", "terminal": True},
    ],
}


def changed(path, value):
    spec = json.loads(json.dumps(CUSTOM))
    *way, last = path
    place = spec
    for key in way:
        place = place[key]
    if value is None:
        del place[last]
    else:
        place[last] = value
    return spec


def test_the_stretch_tokens():
    names = "m r l b end sub_done ls rs p zm zp yp ym wp wm yms zms zps yps d".split()  # noqa: SIM905
    assert list(STRETCH.action_names) == names
    assert [a.name for a in STRETCH.actions if a.terminal] == ["end"]
    assert (STRETCH.radius, STRETCH.offset, STRETCH.on_contact) == (0.1855, (-0.109, 0.0), "stop")
    turns = {a.name: round(math.degrees(a.rotate)) for a in STRETCH.actions if a.rotate}
    assert turns == {"r": -30, "l": 30, "ls": 6, "rs": -6}
    assert {a.name: a.translate for a in STRETCH.actions if a.translate} == {"m": 0.2, "b": -0.2}


def test_each_distinct_motion_counts_once():
    assert len(STRETCH.motions) == 7
    assert STRETCH.motion_of.tolist() == [0, 1, 2, 3, -1, 4, 5, 6, *[4] * 12]
    assert STRETCH.representative.tolist() == [0, 1, 2, 3, 5, 6, 7]
    robot = robot_from_json(CUSTOM)
    assert robot.motions == ((0.25, 0.0), (0.0, 0.5), (0.0, 0.0))
    assert robot.motion_of.tolist() == [0, 1, 2, 2, -1]


@pytest.mark.parametrize(
    "spec", ["stretch", CUSTOM, changed(("on_contact",), None), changed(("footprint", "offset"), None)]
)
def test_round_trip(spec):
    robot = robot_from_json(spec)
    assert robot_from_json(json.loads(json.dumps(robot_to_json(robot)))) == robot


def test_contact_stays_unless_it_says_stop():
    assert robot_from_json(changed(("on_contact",), None)).on_contact == "stay"


@pytest.mark.parametrize(
    ("spec", "path"),
    [
        ("spot", None),
        (17, None),
        ([], None),
        ({}, None),
        ({**CUSTOM, "wheels": 4}, None),
        (changed(("footprint",), []), "footprint"),
        (changed(("footprint", "radius"), "0.3"), "footprint.radius"),
        (changed(("footprint", "radius"), 0), "footprint.radius"),
        (changed(("footprint", "radius"), math.nan), "footprint.radius"),
        (changed(("footprint", "radius"), True), "footprint.radius"),
        (changed(("footprint", "radius"), 10**400), "footprint.radius"),
        (changed(("footprint", "offset"), [0.1]), "footprint.offset"),
        (changed(("footprint", "offset"), [0.1, math.inf]), "footprint.offset[1]"),
        (changed(("on_contact",), "bounce"), "on_contact"),
        (changed(("on_contact",), ["stop"]), "on_contact"),
        (changed(("actions",), {}), "actions"),
        (changed(("actions",), [{"name": str(i)} for i in range(257)]), "actions"),
        (changed(("actions",), [{"name": "end", "terminal": True}]), "actions"),
        (changed(("actions", 1), "left"), "actions[1]"),
        (changed(("actions", 1, "name"), "forward"), "actions[1].name"),
        (changed(("actions", 1, "name"), ""), "actions[1].name"),
        (changed(("actions", 1, "rotate"), 7.0), "actions[1].rotate"),
        (changed(("actions", 0, "translate"), -11), "actions[0].translate"),
        (changed(("actions", 4, "terminal"), 1), "actions[4].terminal"),
        (changed(("actions", 4, "translate"), 0.1), "actions[4]"),
        (changed(("actions", 2, "speed"), 1.0), "actions[2]"),
    ],
)  # fmt: skip
def test_bad_robots_name_the_field(spec, path):
    with pytest.raises(RobotError) as caught:
        robot_from_json(spec)
    assert caught.value.path == path
    assert caught.value.expected
    unit = {"rotate": "radians", "translate": "metres"}.get(str(path).rpartition(".")[2], "")
    assert unit in str(caught.value.expected)


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        ([], "the robot is not an object"),
        ({}, "the robot lacks ['actions', 'footprint']; got []; expected ['actions', 'footprint'], and"),
        ({**CUSTOM, "wheels": 4}, "the robot has unknown fields ['wheels']"),
        (changed(("footprint", "radius"), None), "footprint lacks ['radius']"),
        (changed(("actions", 1), "left"), "actions[1] is not an object"),
    ],
)
def test_what_is_wrong_is_said_of_the_robot_or_of_a_part_of_it(spec, told):
    """In process nothing else names it: the ROS node says that the map cannot be used."""
    with pytest.raises(RobotError) as caught:
        robot_from_json(spec)
    assert str(caught.value).startswith(told)
