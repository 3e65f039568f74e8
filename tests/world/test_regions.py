import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from specshield.errors import MapError
from specshield.world.regions import (
    Area,
    Circle,
    Polygon,
    Rectangle,
    Union,
    area_distance,
    pack_areas,
    region_distance,
    region_from_json,
    region_to_json,
    signed_distance,
)

COORDINATE = st.floats(-50, 50)
SIZE = st.floats(0.1, 20)
POINT = st.tuples(COORDINATE, COORDINATE)
L_SHAPE = Polygon(((0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4)))


@st.composite
def stars(draw):
    """Simple polygons: vertices around a centre, in the order of their angle, in either sense."""
    count = draw(st.integers(3, 8))
    x, y = draw(POINT)
    radii = draw(st.lists(SIZE, min_size=count, max_size=count))
    angles = [2 * math.pi * i / count + 0.1 for i in range(count)]
    vertices = [(x + r * math.cos(a), y + r * math.sin(a)) for r, a in zip(radii, angles, strict=True)]
    return Polygon(tuple(vertices[:: draw(st.sampled_from([1, -1]))]))


SIMPLE = st.one_of(
    st.builds(Circle, POINT, SIZE),
    st.builds(lambda p, w, h: Rectangle(p, (p[0] + w, p[1] + h)), POINT, SIZE, SIZE),
    stars(),
)
REGION = st.one_of(SIMPLE, st.builds(Union, st.lists(SIMPLE, min_size=1, max_size=3).map(tuple)))


@pytest.mark.parametrize(
    ("region", "point", "expected"),
    [
        (Circle((1, 2), 0.5), (1, 2), 0.5),
        (Circle((1, 2), 0.5), (4, 6), -4.5),
        (Rectangle((0, 0), (4, 2)), (1, 1), 1.0),
        (Rectangle((0, 0), (4, 2)), (3.9, 1.5), 0.1),
        (Rectangle((0, 0), (4, 2)), (2, 5), -3.0),
        (Rectangle((0, 0), (4, 2)), (7, 6), -5.0),
        (Rectangle((0, 0), (4, 2)), (4, 1), 0.0),
        (L_SHAPE, (0.5, 0.5), 0.5),
        (L_SHAPE, (2, 2), -1.0),  # in the notch
        (L_SHAPE, (3, 0.9), 0.1),
        (L_SHAPE, (-3, -4), -5.0),
        (L_SHAPE, (0.8, 0.8), math.hypot(0.2, 0.2)),  # nearest is the inner corner
        (Union((Circle((0, 0), 1), Circle((10, 0), 2))), (8, 0), 0.0),
        (Union((Circle((0, 0), 1), Circle((10, 0), 2))), (3, 0), -2.0),
    ],
)
def test_signed_distance_by_hand(region, point, expected):
    assert signed_distance(region, point) == pytest.approx(expected, abs=1e-12)


@given(stars(), POINT)
def test_polygons_against_points_along_the_boundary_and_the_winding_number(polygon, point):
    vertices = np.array(polygon.vertices)
    ahead = np.roll(vertices, -1, axis=0)
    along = np.linspace(0, 1, 2001)[:, None, None]
    boundary = (vertices + along * (ahead - vertices)).reshape(-1, 2)
    spacing = np.linalg.norm(ahead - vertices, axis=1).max() / 2000
    sampled = np.linalg.norm(boundary - point, axis=1).min()
    found = float(signed_distance(polygon, point))
    assert sampled - spacing <= abs(found) <= sampled + 1e-9
    if sampled > 0.01:
        angles = np.unwrap(np.arctan2(*(np.vstack([vertices, vertices[:1]]) - point).T[::-1]))
        turns = (angles[-1] - angles[0]) / (2 * math.pi)
        assert (found > 0) == (abs(turns) > 0.5)


@given(REGION, POINT, st.floats(0, 2 * math.pi), st.floats(0, 5))
def test_moving_by_d_changes_the_distance_by_at_most_d(region, point, angle, d):
    moved = (point[0] + d * math.cos(angle), point[1] + d * math.sin(angle))
    first, second = signed_distance(region, [point, moved])
    assert abs(first - second) <= d + 1e-9


@given(st.lists(REGION, min_size=1, max_size=4), POINT)
def test_packed_regions_give_the_very_same_numbers(regions, point):
    packed = pack_areas([Area(region) for region in regions])
    for i, region in enumerate(regions):
        assert region_distance(packed, i, *point, 0.3) == signed_distance(region, point)


FOOTPRINT = 0.01 * np.stack(np.meshgrid(np.arange(-100, 101), np.arange(-100, 101)), axis=-1).reshape(-1, 2)
DISC = FOOTPRINT[np.hypot(*FOOTPRINT.T) <= 1.0]  # points of the unit disc, at most 0.01 apart on either axis


@given(SIMPLE, POINT, st.floats(-3, 3), st.floats(0.1, 2.0), st.tuples(st.floats(-1, 1), st.floats(-1, 1)))
def test_a_body_against_the_points_of_its_footprint(region, point, theta, radius, offset):
    """Each point of the footprint by itself says whether the body touches the region, or lies inside it."""
    x, y = point
    c, s = math.cos(theta), math.sin(theta)
    centre = np.array([x + c * offset[0] - s * offset[1], y + s * offset[0] + c * offset[1]])
    rim = np.array([[math.cos(a), math.sin(a)] for a in np.linspace(0, 2 * math.pi, 1000)])
    depths = signed_distance(region, centre + radius * np.concatenate([DISC, rim]))
    touches, inside = (
        float(area_distance(Area(region, grown, offset), (x, y, theta))) for grown in (radius, -radius)
    )
    near = 0.02 * radius  # how far the footprint's points lie from one another
    assert (touches > 0) == (depths.max() > 0) or abs(touches) <= near
    assert (inside > 0) == (depths.min() > 0) or abs(inside) <= near


@given(REGION)
def test_json_round_trip(region):
    assert region_from_json(region_to_json(region), "r") == region


def test_points_keep_their_shape():
    assert signed_distance(Circle((0, 0), 1), np.zeros((2, 3, 2))).shape == (2, 3)
    assert signed_distance(Circle((0, 0), 1), [0, 0]).shape == ()


CIRCLE = {"type": "circle", "center": [0, 0], "radius": 1}


@pytest.mark.parametrize(
    ("spec", "path"),
    [
        ([], "r"),
        ({}, "r.type"),
        ({"type": "blob"}, "r.type"),
        ({"type": ["circle"]}, "r.type"),
        ({"type": "circle", "center": [0, 0]}, "r.radius"),
        (CIRCLE | {"radius": 0}, "r.radius"),
        (CIRCLE | {"radius": -1}, "r.radius"),
        (CIRCLE | {"radius": math.nan}, "r.radius"),
        (CIRCLE | {"radius": True}, "r.radius"),
        (CIRCLE | {"radius": 10**400}, "r.radius"),
        (CIRCLE | {"center": [0, "1"]}, "r.center[1]"),
        (CIRCLE | {"center": "00"}, "r.center"),
        (CIRCLE | {"colour": "red"}, "r.colour"),
        ({"type": "rectangle", "min": [0, 0], "max": [1, 0]}, "r.max"),
        ({"type": "rectangle", "min": [0, 0, 0], "max": [1, 1]}, "r.min"),
        ({"type": "polygon", "vertices": [[0, 0], [1, 1]]}, "r.vertices"),
        ({"type": "polygon", "vertices": [[i, i * i] for i in range(1001)]}, "r.vertices"),
        ({"type": "polygon", "vertices": [[0, 0], [1, 0], [1]]}, "r.vertices[2]"),
        ({"type": "polygon", "vertices": [[0, 0], [1, 1], [1, 0], [0, 1]]}, "r.vertices"),  # a bow tie
        ({"type": "polygon", "vertices": [[0, 0], [1, 0], [2, 0]]}, "r.vertices"),  # no area
        ({"type": "polygon", "vertices": [[0, 0], [1, 0], [1, 1], [0, 0]]}, "r.vertices"),  # closed twice
        (
            {"type": "polygon", "vertices": [[0, 0], [4, 0], [4, 4], [2, 0], [0, 4]]},
            "r.vertices",
        ),  # touches itself
        ({"type": "union", "members": []}, "r.members"),
        ({"type": "union", "members": [CIRCLE, {"type": "union", "members": [CIRCLE]}]}, "r.members[1]"),
        ({"type": "union", "members": [CIRCLE, CIRCLE | {"radius": 0}]}, "r.members[1].radius"),
    ],
)
def test_wrong_regions_are_refused_by_path(spec, path):
    with pytest.raises(MapError) as caught:
        region_from_json(spec, "r")
    assert caught.value.path == path
    assert caught.value.expected


def test_vertices_on_a_straight_line_are_fine():
    assert signed_distance(Polygon(((0, 0), (1, 0), (2, 0), (2, 2), (0, 2))), (1, 0.5)) == pytest.approx(0.5)
