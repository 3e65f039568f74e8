"""A map as it lies in a folder: a `.yaml`, its image, and the areas that have names."""

from __future__ import annotations

import json
from pathlib import Path

from specshield.errors import MapError
from specshield.task import parse_regions
from specshield.world.map_server import load_map, read_yaml
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Region


def read_map_files(path: Path) -> tuple[OccupancyGrid, dict[str, Region]]:
    """The map of a `.yaml`, and the areas that `<name>.regions.json` beside it names, where that is there.

    The image is the one that the YAML names, else `<name>.pgm` or `<name>.png`, beside it. Raises MapError.
    """
    try:
        text = path.read_text()
        own = path.parent / Path(str(read_yaml(text).get("image", ""))).name
        images = own, path.with_suffix(".pgm"), path.with_suffix(".png")
        grid = load_map(text, next(image for image in images if image.is_file()).read_bytes())
    except (OSError, UnicodeDecodeError, StopIteration):
        expected = "a .yaml with its image beside it, an OccupancyGrid, or an object as /v1/maps takes it"
        raise MapError("no map can be read there", path="world", got=str(path), expected=expected) from None
    named = path.with_suffix(".regions.json")
    areas = json.loads(named.read_bytes()) if named.is_file() else {}
    return grid, parse_regions({**areas.get("rooms", {}), **areas.get("regions", {})})
