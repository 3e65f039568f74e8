import io
import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from PIL import Image

from specshield.errors import MapError
from specshield.world.map_server import FORMAT, dump_map, load_map
from specshield.world.nav_msgs import from_occupancy_grid
from specshield.world.occupancy import OccupancyGrid

MAPS = Path(__file__).parents[3] / "shared/data/maps"
FINITE = st.floats(-1e4, 1e4)


def metadata(**changes):
    lines = {
        "image": "/etc/passwd",
        "resolution": 0.05,
        "origin": [0.0, 0.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.25,
    } | changes
    return "\n".join(f"{key}: {value}" for key, value in lines.items() if value is not None)


def pgm(rows):
    height, width = len(rows), len(rows[0])
    return b"P5\n# made by hand\n%d %d\n255\n" % (width, height) + bytes(v for row in rows for v in row)


def png(array, mode=None):
    out = io.BytesIO()
    Image.fromarray(np.array(array, dtype=np.uint16 if mode == "I;16" else np.uint8)).save(out, "PNG")
    return out.getvalue()


def occupied(image, **changes):
    return load_map(metadata(**changes), image).occupied.astype(int).tolist()


def test_row_0_of_the_image_is_the_top_of_the_map():
    rows = pgm([[0, 254], [254, 254], [205, 254]])  # 205 is what map_saver writes for unknown
    assert occupied(rows, free_thresh=0.196) == [[1, 0], [0, 0], [1, 0]]


def test_trinary_thresholds():
    """occ = (255 - v) / 255: free below 0.25 (v >= 192), unknown and occupied alike above."""
    row = [255, 192, 191, 128, 89, 0]
    assert occupied(pgm([row])) == [[0, 0, 1, 1, 1, 1]]
    assert occupied(pgm([row]), free_thresh=0.6) == [[0, 0, 0, 0, 1, 1]]


def test_negate():
    assert occupied(pgm([[255, 64, 63, 0]]), negate=1) == [[1, 1, 0, 0]]
    assert occupied(pgm([[255, 0]]), negate="true") == [[1, 0]]


def test_scale_is_free_up_to_25_percent_between_the_thresholds():
    """v = 166: (89 / 255 - 0.25) / 0.4 is 24.8 percent, which rounds to 25; v = 165 gives 25.7."""
    assert occupied(pgm([[255, 192, 166, 165, 120, 0]]), mode="scale") == [[0, 0, 0, 1, 1, 1]]
    assert occupied(png([[[255, 255], [255, 254], [0, 255]]]), mode="scale") == [[0, 1, 1]]  # grey with alpha


def test_raw_values_are_percent_and_the_rest_unknown():
    assert occupied(pgm([[0, 25, 26, 100, 101, 255]]), mode="raw", negate=1) == [[0, 0, 1, 1, 1, 1]]


def test_trinary_averages_alpha_in_with_the_colours():
    pixels = [[[255, 255, 255, 255], [255, 255, 255, 0], [255, 0, 0, 255], [255, 255, 255]]]
    assert occupied(png([pixels[0][:3]])) == [
        [0, 1, 1]
    ]  # (255 * 3 + 0) / 4 is 0.75: occ 0.25 is not below 0.25
    assert occupied(png([pixels[0][3:]])) == [[0]]


def test_sixteen_bits_and_plain_pgm():
    assert occupied(png([[65535, 50000, 49000, 0]], "I;16")) == [[0, 0, 1, 1]]
    assert occupied(b"P5 2 1 65535 " + bytes([255, 255, 0, 0])) == [[0, 1]]
    assert occupied(b"P2\n2 1\n15\n15 0\n") == [[0, 1]]


def test_origin_and_numbers_as_ros_writes_them():
    grid = load_map(metadata(resolution="5e-2", origin="[-1e1, 2, 0.5]"), pgm([[255]]))
    assert (grid.resolution, grid.origin) == (0.05, (-10.0, 2.0, 0.5))


def test_a_yaw_in_degrees_is_refused_where_a_map_is_sent():
    image = pgm([[255]])
    with pytest.raises(MapError, match="radians") as caught:
        FORMAT.parse(metadata(origin="[0, 0, 90]").encode(), image)
    assert caught.value.path == "origin[2]"
    grid, _ = FORMAT.parse(metadata(origin=f"[0, 0, {2 * math.pi}]").encode(), image)
    assert load_map(*dump_map(grid)) == grid


@given(
    arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=12)),
    st.floats(1e-3, 50),
    st.tuples(FINITE, FINITE, FINITE),
)
def test_round_trip(cells, resolution, origin):
    grid = OccupancyGrid(cells, resolution, origin)
    assert load_map(*dump_map(grid)) == grid


@pytest.mark.parametrize(
    ("changes", "path"),
    [
        ({"resolution": None}, "resolution"),
        ({"resolution": 0}, "resolution"),
        ({"resolution": ".nan"}, "resolution"),
        ({"resolution": "[1]"}, "resolution"),
        ({"resolution": "true"}, "resolution"),
        ({"origin": "[0, 0]"}, "origin"),
        ({"origin": "[0, 0, .inf]"}, "origin[2]"),
        ({"origin": "{}"}, "origin"),
        ({"negate": 2}, "negate"),
        ({"negate": None}, "negate"),
        ({"mode": "binary"}, "mode"),
        ({"mode": "[trinary]"}, "mode"),
        ({"occupied_thresh": 1.5}, "occupied_thresh"),
        ({"free_thresh": 0.65}, "free_thresh"),
        ({"image": "[" * 2000}, "metadata"),
        ({"image": "&a [1, 2]", "x": "*a"}, "metadata"),
        ({"image": "!!python/object/apply:os.getcwd []"}, "metadata"),
        ({"image": "!!timestamp today"}, "metadata"),
        ({"image": "x" * 20_000}, "metadata"),
        ({"x": "1\nresolution: 9.0"}, "metadata"),  # ROS would take the first, PyYAML the last
    ],
)
def test_wrong_metadata_is_refused_by_name(changes, path):
    with pytest.raises(MapError) as caught:
        load_map(metadata(**changes), pgm([[255]]))
    assert caught.value.path == path
    assert caught.value.expected


@pytest.mark.parametrize("text", ["", "- a", "resolution", "a: b: c", "\0"])
def test_text_that_is_no_metadata(text):
    with pytest.raises(MapError):
        load_map(text, pgm([[255]]))


WHOLE = png(np.random.default_rng(0).integers(0, 255, (40, 40)))


@pytest.mark.parametrize(
    ("image", "path"),
    [
        (b"", "image"),
        (b"GIF89a" + bytes(50), "image"),
        (b"P5\n", "image"),
        (b"P5\nten 10\n255\n", "image"),
        (b"P5\n10 10\n255\n" + bytes(99), "image"),
        (b"P2\n2 2\n255\n0 0 0", "image"),
        (WHOLE[:20], "image"),
        (WHOLE[: len(WHOLE) // 2], "image"),
        (b"Pf\n1 1\n-1.0\n" + bytes(4), "image"),  # PFM: an image of floats
        (b"P5\n4001 1\n255\n" + bytes(4001), "width"),
        (b"P5\n1 4001\n255\n" + bytes(4001), "height"),
        (b"P5\n0 4\n255\n", "width"),
    ],
)
def test_broken_images_are_refused(image, path):
    with pytest.raises(MapError) as caught:
        load_map(metadata(), image)
    assert caught.value.path in (path, "image")
    assert caught.value.expected


def test_a_decompression_bomb_is_refused_before_it_is_unpacked():
    out = io.BytesIO()
    Image.new("L", (9000, 9000)).save(out, "PNG")
    tracemalloc.start()
    with pytest.raises(MapError):
        load_map(metadata(), out.getvalue())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10_000_000


def message(width=3, height=2, **origin):
    turn = {
        "position": {"x": 1.0, "y": 2.0, "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    return {
        "resolution": 0.5,
        "width": width,
        "height": height,
        "origin": turn | origin,
        "map_load_time": {"sec": 0},
    }


def test_an_occupancy_grid_message():
    half = math.sqrt(0.5)
    info = message(orientation={"x": 0.0, "y": 0.0, "z": half, "w": half})
    grid = from_occupancy_grid(info, [0, 25, 26, 100, -1, 0])
    assert grid.occupied.astype(int).tolist() == [[0, 0, 1], [1, 1, 0]]  # data starts at the lowest row
    assert grid.origin == pytest.approx((1.0, 2.0, math.pi / 2))


@pytest.mark.parametrize(
    ("info", "data", "path"),
    [
        (message(), [0] * 5, "data"),
        (message(), "000000", "data"),
        (message(), [0, 0, 0, 101, 0, 0], "data[3]"),
        (message(), [0, -2, 0, 0, 0, 0], "data[1]"),
        (message(), [0, 0.5, 0, 0, 0, 0], "data[1]"),
        (message(), [0, [0], 0, 0, 0, 0], "data[1]"),
        (message(), [0, None, 0, 0, 0, 0], "data[1]"),
        (message(), [0, 100, True, 0, 0, 0], "data[2]"),
        (message(), [0, 10**30, 0, 0, 0, 0], "data[1]"),
        (message(width=4001), [0], "info.width"),
        (message(height=0), [], "info.height"),
        (message(width=3.0), [0] * 6, "info.width"),
        (message(position={"x": 0.0}), [0] * 6, "info.origin.position.y"),
        (message(orientation={"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}), [0] * 6, "info.origin.orientation"),
        (message(orientation={"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}), [0] * 6, "info.origin.orientation"),
        ({}, [], "info.width"),
        (7, [], "info"),
    ],
)
def test_wrong_messages_are_refused_by_path(info, data, path):
    with pytest.raises(MapError) as caught:
        from_occupancy_grid(info, data)
    assert caught.value.path == path
    assert caught.value.expected


def test_of_a_message_that_ros2_topic_echo_cut_off_it_is_said_how_to_get_it_whole():
    with pytest.raises(MapError, match=r"cells were cut off.*--full-length"):
        from_occupancy_grid(message(), [0, 0, "..."])
    with pytest.raises(MapError, match="data is not a usable list"):
        from_occupancy_grid(message(), b"\0\0\0")


@pytest.mark.skipif(not MAPS.is_dir(), reason="there is no folder ../shared/data/maps")
@pytest.mark.parametrize(
    ("name", "shape", "origin", "darkest_free", "point", "inside"),
    [
        ("depot", (307, 604), (0.0, 0.0, 0.0), 192, (20.0, 4.7), False),
        ("depot_keepout", (307, 604), (0.0, 0.0, 0.0), 192, (20.0, 4.7), True),
        ("tb3_sandbox", (384, 384), (-10.0, -10.0, 0.0), 206, (0.0, 0.0), True),  # the middle pillar
    ],
)
def test_maps_of_navigation2(name, shape, origin, darkest_free, point, inside):
    image = (MAPS / f"{name}.pgm").read_bytes()
    grid = load_map((MAPS / f"{name}.yaml").read_text(), image)
    assert grid.occupied.shape == shape
    assert grid.origin == origin
    pixels = image[-shape[0] * shape[1] :]
    assert np.count_nonzero(~grid.occupied) == sum(v >= darkest_free for v in pixels)
    column, row = (grid.to_grid(point) / grid.resolution).astype(int)
    assert grid.occupied[row, column] == inside
    assert load_map(*dump_map(grid)) == grid
