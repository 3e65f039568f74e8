"""Reads a map from its files: a `.yaml`, its image, and its named areas."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

from specshield.errors import MapError
from specshield.task import parse_regions
from specshield.world import checks
from specshield.world.map_server import parse, read_yaml, text_of
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Region


def read_map_files(path: Path) -> tuple[OccupancyGrid, dict[str, Region]]:
    """The map of a `.yaml`, and the areas in `<name>.regions.json` beside it, if there is such a file.

    The image, beside it too, is the PGM or PNG that the YAML names, else `<name>.pgm` or `<name>.png`. Raises
    MapError.
    """
    metadata = None
    with suppress(OSError):
        metadata = path.read_bytes() if path.suffix.lower() in (".yaml", ".yml") else None
    if metadata is None:
        expected = "the path of a .yaml with its image beside it; or an OccupancyGrid or an object with a "
        expected += "`format`, as /v1/maps takes it"
        told = "no map can be read there" if path.exists() else "there is no such file"
        raise MapError(told, path="world", got=str(path), expected=expected)
    own = path.parent / Path(str(read_yaml(text_of(metadata)).get("image", ""))).name
    images = own, path.with_suffix(".pgm"), path.with_suffix(".png")
    found = [each for each in images if each.suffix.lower() in (".pgm", ".png") and each.is_file()]
    if not found:
        expected = "the PGM or PNG that the YAML names, or one called like the YAML"
        told = "the map's image is not beside its YAML"
        raise MapError(told, path="image", got=str(path), expected=expected)
    grid, _ = parse(metadata, found[0].read_bytes())
    named = path.with_suffix(".regions.json")
    try:
        areas = json.loads(named.read_bytes()) if named.is_file() else {}
    except (ValueError, RecursionError) as error:
        told, expected = f"{named} cannot be read: {error}", "a JSON object with `rooms`, `regions` or both"
        raise MapError(told, path=named.name, expected=expected) from None
    checks.mapping(areas, named.name)
    rooms, regions = (
        checks.mapping(areas.get(kind, {}), f"{named.name}.{kind}") for kind in ("rooms", "regions")
    )
    return grid, parse_regions({**rooms, **regions}, named.name)
