"""Maps of ROS's map_server: a YAML file with an image.

The two give a value for each cell, -1 for unknown and 0 to 100 for how occupied it is in percent, as
nav2_map_server publishes it. Cells up to FREE_AT_MOST are free; all others, the unknown included, are
occupied.
"""

from __future__ import annotations

import io
import math
from collections.abc import Hashable
from contextlib import suppress
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from specshield.arrays import Floats
from specshield.errors import MapError
from specshield.world import checks
from specshield.world.formats import MapFormat, Rooms
from specshield.world.occupancy import MAX_SIDE, OccupancyGrid, check_size

FREE_AT_MOST = 25  # percent: what nav2's map_saver writes as free by default
MAX_YAML = 16_384  # characters; a map's YAML has some 150
FULL_TURN = 2.0 * math.pi + 1e-6  # [rad] a larger yaw is taken to be in degrees
UNKNOWN = -1
MODES = ("trinary", "scale", "raw")
ROWS = 256  # that are read at once: the fractions of a whole map of 4,000 x 4,000 cells took 700 MB


def load_map(yaml_text: str, image: bytes) -> OccupancyGrid:
    """A map_server map. `image` holds PGM or PNG, row 0 the top of the map; the YAML's `image:` is ignored.

    Values follow nav2_map_server (map_io.cpp): mode raw ignores negate and the thresholds, trinary averages
    alpha with the colours, and scale takes transparent pixels for unknown. Raises MapError with the field.
    """
    document = read_yaml(yaml_text)
    resolution = _scalar(document, "resolution", 1e-4, 100.0)
    origin = checks.items(checks.member(document, "origin", ""), "origin", 3, 3)
    x, y, yaw = (_number(v, f"origin[{i}]") for i, v in enumerate(origin))
    free_thresh = _scalar(document, "free_thresh", 0.0, 1.0)
    occupied_thresh = _scalar(document, "occupied_thresh", 0.0, 1.0)
    if free_thresh >= occupied_thresh:
        below = f"a number below occupied_thresh, {occupied_thresh:g}"
        raise checks.wrong("number", "free_thresh", free_thresh, below)
    negate = checks.member(document, "negate", "")
    if negate not in (0, 1):  # True and False as well
        raise checks.wrong("flag", "negate", negate, "0 or 1")
    mode = document.get("mode", "trinary")
    if mode not in MODES:
        raise checks.wrong("mode", "mode", mode, "one of " + ", ".join(MODES))

    pixels = _read_image(image)
    values = np.empty(pixels.shape[:2], np.int8)
    for row in range(0, len(pixels), ROWS):
        band = slice(row, row + ROWS)
        values[band] = _values(pixels[band], mode, bool(negate), free_thresh, occupied_thresh)
    return from_values(values[::-1], resolution, (x, y, yaw))


def _values(pixels: NDArray[Any], mode: str, negate: bool, free: float, occupied: float) -> NDArray[Any]:
    """The values of pixels, from UNKNOWN to 100. free, occupied: the thresholds."""
    shade, opacity = _shades(pixels, alpha_counts=mode == "trinary")
    if mode == "raw":
        values = np.floor(shade * 255 + 0.5)
        values[values > 100] = UNKNOWN
        return values
    occupancy = shade if negate else 1.0 - shade
    middle = np.rint((occupancy - free) / (occupied - free) * 100.0) if mode == "scale" else UNKNOWN
    values = np.where(occupancy > occupied, 100, np.where(occupancy < free, 0, middle))
    if mode == "scale":
        values[opacity < 1.0] = UNKNOWN
    return values


def dump_map(grid: OccupancyGrid, image: str = "map.pgm") -> tuple[str, bytes]:
    """(YAML text, PGM bytes) that load_map reads back as an equal grid. `image` is the name it gives."""
    x, y, yaw = (repr(v) for v in grid.origin)
    text = (
        f"image: {image}\nmode: trinary\nresolution: {grid.resolution!r}\norigin: [{x}, {y}, {yaw}]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )
    pixels = np.where(grid.occupied[::-1], 0, 254).astype(np.uint8)
    return text, b"P5\n%d %d\n255\n" % (grid.width, grid.height) + pixels.tobytes()


def from_values(values: NDArray[Any], resolution: float, origin: tuple[float, float, float]) -> OccupancyGrid:
    """The grid of values [height, width], row 0 the lowest y."""
    return OccupancyGrid((values < 0) | (values > FREE_AT_MOST), resolution, origin)


class _Loader(yaml.SafeLoader):
    """Loads plain data alone. It refuses aliases, which can make a short text grow without bound, and a
    member that is given twice, of which ROS takes the first and PyYAML the last.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        names = [key.value for key, _ in node.value]
        for i, (key, _) in enumerate(node.value):
            if key.value in names[:i]:
                problem = f"{key.value!r} is there twice"
                raise yaml.constructor.ConstructorError(problem=problem, problem_mark=key.start_mark)
        return super().construct_mapping(node, deep)

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.composer.ComposerError(problem="aliases are not read")
        return super().compose_node(parent, index)


def read_yaml(text: str) -> dict[str, Any]:
    if len(text) > MAX_YAML:
        expected = f"at most {MAX_YAML} characters"
        raise MapError("the YAML is too long", path="metadata", got=len(text), expected=expected)
    try:
        document = yaml.load(text, Loader=_Loader)
    except Exception as error:  # tags on text that they do not fit raise anything
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "it is not YAML"
        said = f"the YAML cannot be read{where}: {problem}"
        raise MapError(said, path="metadata", expected="a map_server YAML") from error
    if not isinstance(document, dict):
        raise checks.wrong("map_server YAML", "metadata", document, "resolution, origin, negate, ...")
    return document


def _scalar(document: dict[str, Any], key: str, low: float, high: float) -> float:
    return _number(checks.member(document, key, ""), key, low, high)


def _number(value: Any, path: str, low: float = -checks.LIMIT, high: float = checks.LIMIT) -> float:
    """`value` as a number. YAML 1.1 reads 5e-2 as text, but ROS reads it as a number."""
    if isinstance(value, str):
        with suppress(ValueError):
            return checks.number(float(value), path, low, high)
    return checks.number(value, path, low, high)


def _read_image(image: bytes) -> NDArray[Any]:
    """The pixels, [height, width] if grey, else [height, width, 3 or 4]; 8 bits are of the type uint8. The
    size is checked before anything is decoded.
    """
    got = f"{len(image)} bytes"
    try:
        picture = Image.open(io.BytesIO(image), formats=["PPM", "PNG"])
        if picture.mode == "F":
            raise ValueError("PFM, which Pillow counts as PPM")
    except Image.DecompressionBombError as error:
        most = f"at most {MAX_SIDE} x {MAX_SIDE} pixels"
        raise MapError("the image is too large", path="image", got=got, expected=most) from error
    except Exception as error:  # decoders raise whatever the bytes lead to
        problem = "the image has no header of a PGM or PNG"
        raise MapError(problem, path="image", got=got, expected="PGM or PNG") from error
    check_size(*picture.size)
    try:
        if picture.mode[0] == "I":  # 16 bits
            return np.asarray(picture)
        if "A" in picture.mode or "transparency" in picture.info:
            return np.asarray(picture.convert("RGBA"))
        return np.asarray(picture.convert("L" if picture.mode in ("1", "L") else "RGB"))
    except Exception as error:
        problem = "the image is broken or cut off"
        raise MapError(problem, path="image", got=got, expected="a whole PGM or PNG") from error


def _shades(pixels: NDArray[Any], alpha_counts: bool) -> tuple[Floats, Floats]:
    """(shade, opacity) of pixels, each in [0, 1]."""
    if pixels.ndim == 2:
        shade = pixels / (255 if pixels.dtype == np.uint8 else 65535)
        return shade, np.ones_like(shade)
    colours = pixels[..., : 4 if alpha_counts else 3].mean(axis=-1) / 255
    return colours, pixels[..., 3] / 255 if pixels.shape[-1] == 4 else np.ones_like(colours)


def text_of(metadata: bytes) -> str:
    try:
        return metadata.decode()
    except UnicodeDecodeError as error:
        raise checks.wrong("text", "metadata", str(error), "YAML in UTF-8") from None


def parse(metadata: bytes, image: bytes) -> tuple[OccupancyGrid, Rooms]:
    """The map that was sent. A yaw in degrees is refused here alone: maps that a server kept may have one."""
    grid = load_map(text_of(metadata), image)
    if abs(grid.origin[2]) > FULL_TURN:
        raise checks.wrong("yaw", "origin[2]", grid.origin[2], "radians, from -2 pi to 2 pi")
    return grid, {}


FORMAT = MapFormat(
    "A map of ROS's map_server, as two files.",
    {
        "metadata": {"description": "The map_server YAML; its `image:` is ignored."},
        "image": {"description": "The image: PGM or PNG."},
    },
    parse,
    files=True,
)
