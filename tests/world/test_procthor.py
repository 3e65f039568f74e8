import copy
import json
import math

import numpy as np
import pytest
from scipy import ndimage

from specshield.errors import MapError
from specshield.world.procthor import load_house
from specshield.world.regions import Union, signed_distance
from tests.houses import HOUSES, needs_houses

SIZES = {
    "Bed": {"type": "Bed", "size": [1.0, 0.5, 2.0]},
    "Lamp": {"type": "Lamp", "size": [0.2, 0.4, 0.2]},
    "Pole": {"type": "Pole", "size": [0.1, 2.0, 0.1]},
}


def point(x, z, y=0.0):
    return {"x": x, "y": y, "z": z}


def room(kind, x0, z0, x1, z1):
    return {"roomType": kind, "floorPolygon": [point(x0, z0), point(x0, z1), point(x1, z1), point(x1, z0)]}


def wall(name, x0, z0, x1, z1, **more):
    return {
        "id": name,
        "polygon": [point(x0, z0), point(x1, z1), point(x0, z0, 3.0), point(x1, z1, 3.0)],
        **more,
    }


def door(low, high, **changes):
    hole = [point(low, 0.0), point(high, 0.0, 2.0)]
    return {
        "room0": "a", "room1": "b", "wall0": "left", "wall1": "right",
        "holePolygon": hole, "openable": True, "openness": 1, **changes,
    }  # fmt: skip


def thing(asset, x, z, y, kinematic=True, yaw=0.0, pitch=0.0, **more):
    rotation = {"x": pitch, "y": yaw, "z": 0.0}
    return {
        "assetId": asset,
        "position": point(x, z, y),
        "rotation": rotation,
        "kinematic": kinematic,
        **more,
    }


def house(doors=(), objects=(), walls=()):
    """Two rooms of 4 x 4 m side by side, a wall at x = 4 between them, seen from either side."""
    inner = [wall("left", 4.0, 4.0, 4.0, 0.0), wall("right", 4.0, 0.0, 4.0, 4.0)]
    outer = [wall("wall|exterior|0", 0.0, 0.0, 8.0, 0.0)]
    return {
        "rooms": [room("Bedroom", 0, 0, 4, 4), room("Bedroom", 4, 0, 8, 4)],
        "walls": [*inner, *outer, *walls],
        "doors": list(doors),
        "windows": [{"wall0": "left", "holePolygon": [point(0.5, 0.0, 1.0), point(1.5, 0.0, 2.0)]}],
        "objects": list(objects),
        "metadata": {"agent": {"position": point(1.0, 2.0), "rotation": {"x": 0, "y": 270, "z": 0}}},
    }


def load(*args, **kwargs):
    return load_house(house(*args, **kwargs), SIZES, 0.1)[0]


def occupied(grid, x, y):
    column, row = (grid.to_grid([x, y]) / grid.resolution).astype(int)
    return bool(grid.occupied[row, column])


def test_rooms_are_free_and_everything_else_is_not():
    grid = load()
    assert grid.bounds == pytest.approx((-0.1, -0.1, 8.1, 4.1))
    assert not occupied(grid, 2.0, 2.0)
    assert occupied(grid, -0.05, 2.0)
    assert all(occupied(grid, 4.0 + d, y) for d in (-0.05, 0.05) for y in np.arange(0.05, 4, 0.1))


def test_a_door_opens_the_wall_from_both_sides():
    """holePolygon runs from the first point of wall0, here the far end: 1.0 to 2.0 is y from 3 to 2."""
    grid = load(doors=[door(1.0, 2.0)])
    column = int(4.05 / 0.1) + 1
    free = np.flatnonzero(~grid.occupied[:, column])
    assert (free[0], free[-1], len(free)) == (
        21 + 1,
        29 + 1 - 1,
        8,
    )  # cells that the jambs touch stay occupied
    assert not occupied(grid, 4.0, 2.5)


@pytest.mark.parametrize(
    ("changes", "is_open"),
    [
        ({}, True),
        ({"openness": None, "openable": None}, True),  # a frame
        ({"openness": 0}, False),
        ({"openness": 0.5}, False),
        ({"room1": "a"}, False),
        ({"wall1": "wall|exterior|0"}, False),
    ],
)
def test_which_doors_can_be_passed(changes, is_open):
    assert occupied(load(doors=[door(1.0, 2.0, **changes)]), 3.96, 2.5) != is_open


def test_walls_marked_empty_are_open_and_windows_are_not():
    plan = house()
    for one in plan["walls"][:2]:
        one["empty"] = True
    grid, _ = load_house(plan, SIZES, 0.1)
    assert not occupied(grid, 4.0, 3.0)
    assert occupied(load(), 4.0, 3.0)  # where the window is


def test_furniture_stands_where_it_stands():
    grid = load(objects=[thing("Bed", 2.0, 2.0, 0.25), thing("Bed", 6.0, 2.0, 0.25, yaw=90.0)])
    assert [occupied(grid, 2.0 + dx, 2.0) for dx in (-0.45, 0.45, 0.65)] == [True, True, False]
    assert [occupied(grid, 2.0, 2.0 + dy) for dy in (-0.95, 0.95, 1.15)] == [True, True, False]
    assert [occupied(grid, 6.0 + dx, 2.0) for dx in (-0.95, 0.95, 1.15)] == [True, True, False]


def test_yaw_is_clockwise_seen_from_above():
    """Forward is (sin yaw, cos yaw): at 45 degrees a bed, long along forward, points to the upper right."""
    grid = load(objects=[thing("Bed", 2.0, 2.0, 0.25, yaw=45.0)])
    assert occupied(grid, 2.6, 2.6)
    assert not occupied(grid, 2.6, 1.4)


def test_what_hangs_or_moves_is_left_out():
    assert not occupied(load(objects=[thing("Lamp", 2.0, 2.0, 1.5)]), 2.0, 2.0)
    assert not occupied(load(objects=[thing("Bed", 2.0, 2.0, 0.25, kinematic=False)]), 2.0, 2.0)


def test_a_tilted_thing_reaches_as_low_and_far_as_it_does():
    """A pole of 2 m with its centre at 1.4 m hangs; laid flat along +z at 0.05 m it covers 2 m of floor."""
    assert not occupied(load(objects=[thing("Pole", 2.0, 2.0, 1.4)]), 2.0, 2.0)
    flat = load(objects=[thing("Pole", 2.0, 2.0, 0.05, pitch=90.0)])
    assert [occupied(flat, 2.0, 2.0 + d) for d in (-0.95, 0.95, 1.25)] == [True, True, False]
    assert not occupied(flat, 2.25, 2.0)


def test_children_count_like_their_parents():
    child = thing("Bed", 6.0, 2.0, 0.25)
    grid = load(objects=[thing("Lamp", 2.0, 2.0, 1.5, children=[child])])
    assert occupied(grid, 6.0, 2.0)


def test_rooms_of_one_kind_are_numbered_and_joined():
    _, rooms = load_house(house(), SIZES, 0.1)
    assert list(rooms) == ["Bedroom_1", "Bedroom_2", "Bedroom"]
    assert isinstance(rooms["Bedroom"], Union)
    assert signed_distance(rooms["Bedroom"], [[2, 2], [6, 2], [9, 2]]).tolist() == [2.0, 2.0, -1.0]
    assert signed_distance(rooms["Bedroom_2"], [2, 2]) == -2.0


def broken(path, value):
    plan = house(
        doors=[door(1.0, 2.0)], objects=[thing("Bed", 2.0, 2.0, 0.25, children=[thing("Lamp", 2, 2, 1.5)])]
    )
    at = plan
    for key in path[:-1]:
        at = at[key]
    if value is None:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return plan


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        (["objects", 0, "assetId"], "Sofa_9", "objects[0].assetId"),
        (["objects", 0, "children", 0, "assetId"], "Sofa_9", "objects[0].children[0].assetId"),
        (["objects", 0, "position"], None, "objects[0].position"),
        (["objects", 0, "position", "x"], math.nan, "objects[0].position.x"),
        (["objects", 0, "children"], 3, "objects[0].children"),
        (["objects", 0], "bed", "objects[0]"),
        (["rooms"], [], "rooms"),
        (["rooms"], None, "rooms"),
        (["rooms", 1, "roomType"], "not a name", "rooms[1].roomType"),
        (["rooms", 0, "floorPolygon"], [point(0, 0), point(1, 1)], "rooms[0].floorPolygon"),
        (["rooms", 0, "floorPolygon", 1], point(8, 0), "rooms[0].floorPolygon.vertices"),
        (["rooms", 0, "floorPolygon", 1, "x"], -500.0, "width"),
        (["doors", 0, "wall0"], "nowhere", "doors[0].wall0"),
        (["doors", 0, "holePolygon"], [], "doors[0].holePolygon"),
        (["walls", 0, "polygon", 0, "z"], "0", "walls[0].polygon[0].z"),
        (["walls", 2, "id"], "left", "walls[2].id"),
        (["objects", 0, "kinematic"], "true", "objects[0].kinematic"),
        (["objects", 0, "children", 0, "kinematic"], 1, "objects[0].children[0].kinematic"),
    ],
)
def test_wrong_houses_are_refused_by_path(path, value, named):
    with pytest.raises(MapError) as caught:
        load_house(broken(path, value), SIZES, 0.1)
    assert caught.value.path == named
    assert caught.value.expected
    assert value != "Sofa_9" or "Sofa_9" in caught.value.message


@pytest.mark.parametrize("sizes", [[], {"Bed": {}}, {"Bed": {"size": [1, 1]}}, {"Bed": {"size": [1, 1, -1]}}])
def test_wrong_sizes_are_refused(sizes):
    with pytest.raises(MapError):
        load_house(house(objects=[thing("Bed", 2.0, 2.0, 0.25)]), sizes, 0.1)


def test_children_nested_without_end_are_no_stack_overflow():
    deep = thing("Lamp", 2.0, 2.0, 1.5)
    for _ in range(5000):
        deep = thing("Lamp", 2.0, 2.0, 1.5, children=[deep])
    assert not occupied(load(objects=[deep]), 2.0, 2.0)


@pytest.fixture(scope="module")
def sizes():
    return json.loads((HOUSES / "asset-sizes.json").read_text())


@needs_houses
@pytest.mark.parametrize("number", [0, 1, 2, 5, 10, 14])
def test_procthor_houses(number, sizes):
    plan = json.loads((HOUSES / f"house_{number}.json").read_text())
    grid, rooms = load_house(copy.deepcopy(plan), sizes, 0.05)
    assert set(rooms) == {"Bedroom", "Bathroom", "Kitchen", "LivingRoom"}

    agent = plan["metadata"]["agent"]  # where ProcTHOR starts the robot; map (x, y) is house (x, z)
    x, y = agent["position"]["x"], agent["position"]["z"]
    theta = math.pi / 2 - math.radians(agent["rotation"]["y"])
    centre = grid.to_grid([x - 0.109 * math.cos(theta), y - 0.109 * math.sin(theta)])
    corners = np.argwhere(grid.occupied)[:, ::-1] * grid.resolution
    apart = np.linalg.norm(
        np.maximum(np.maximum(corners - centre, centre - corners - grid.resolution), 0), axis=1
    )
    assert apart.min() > 0.1855  # the robot's disc is free of every occupied square

    wide_enough, _ = ndimage.label(grid.clearance > 0.1855 + 0.05)
    column, row = (grid.to_grid([x, y]) / grid.resolution).astype(int)
    reached = wide_enough == wide_enough[row, column]
    for name, region in rooms.items():
        assert np.count_nonzero(reached & (signed_distance(region, grid.centres) > 0)) * 0.05**2 > 1.0, name
