"""The maps a server has: those of `maps/`, under their names, and those sent, in `<data>/maps/<id>/`."""

from __future__ import annotations

import hashlib
import io
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from specshield.errors import MapError, NotFound, SpecshieldError
from specshield.service.library import files
from specshield.service.settings import Settings
from specshield.task import parse_regions
from specshield.world.map_server import dump_map, load_map
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Region, region_to_json

KEPT_IN_MEMORY = 16  # one of 4,000 x 4,000 cells takes some 150 MB
log = logging.getLogger("specshield")


@dataclass(frozen=True)
class Map:
    id: str
    grid: OccupancyGrid
    rooms: Mapping[str, Region]
    name: str | None = None

    def to_json(self) -> dict[str, Any]:
        return {
            "id": self.id,
            "name": self.name,
            "resolution": self.grid.resolution,
            "width": self.grid.width,
            "height": self.grid.height,
            "origin": list(self.grid.origin),
            "bounds": list(self.grid.bounds),
            "rooms": _rooms_json(self.rooms),
        }

    def png(self) -> bytes:
        """Black is occupied; row 0 of the image is the map's highest y."""
        buffer = io.BytesIO()
        Image.fromarray(np.where(self.grid.occupied[::-1], 0, 255).astype(np.uint8)).save(buffer, "PNG")
        return buffer.getvalue()


class Maps:
    """The calls block: they read and write files."""

    def __init__(self, settings: Settings) -> None:
        self._folder, self._limit = settings.data_dir / "maps", settings.max_maps
        self._folder.mkdir(parents=True, exist_ok=True)
        self._max_rooms = settings.max_spec_bytes
        self._recent = files.Recent[Map](KEPT_IN_MEMORY)
        self._named = {str(found.name): found for found in _shipped(settings.maps_dir)}

    def get(self, key: str) -> Map:
        """By id, by the name of one that came with the server, or by the hash of the grid alone, which is
        what a policy's card knows. Raises NotFound."""
        for found in self._named.values():
            if key in (found.name, found.id, found.grid.content_hash):
                return found
        if files.HASH.fullmatch(key):
            if (self._folder / key).is_dir():
                return self._recent.get(key, lambda: self._read(key))
            for id in files.ids(self._folder):
                if files.read_json(self._folder / id / "map.json")["grid"] == key:
                    return self.get(id)
        raise NotFound(
            f"there is no map {key!r}", path="map_id", got=key, expected="an id or name from /v1/maps"
        )

    def show(self, key: str) -> dict[str, Any]:
        """The map as JSON, which can be had without reading the cells. Raises NotFound."""
        if files.HASH.fullmatch(key) and (self._folder / key).is_dir():
            return self._shown(key)
        return self.get(key).to_json()

    def add(self, grid: OccupancyGrid, rooms: Mapping[str, Region]) -> Map:
        """Keeps a map, unless there is one of this content already. Raises LimitReached."""
        id = _id(grid, rooms)
        try:
            return self.get(id)
        except NotFound:
            files.check_room(self._folder, self._limit, "maps")
        if len(files.to_json(_rooms_json(rooms))) > self._max_rooms:
            raise MapError(
                "the outlines of the rooms are too large", path="rooms",
                expected=f"at most {self._max_rooms} bytes as JSON: simpler outlines",
            )  # fmt: skip
        text, image = dump_map(grid)
        made = Map(id, grid, rooms)
        meta = files.to_json({"grid": grid.content_hash, "shown": made.to_json()})
        files.write_folder(self._folder / id, {"map.yaml": text.encode(), "map.pgm": image, "map.json": meta})
        return self._recent.get(id, lambda: made)

    def page(self, after: str | None, limit: int) -> tuple[list[dict[str, Any]], str | None]:
        """One page of maps, as JSON, which can be had without reading the cells."""
        keys, following = files.page(
            [*self._named, *files.ids(self._folder)], after, limit,
            lambda key: files.size(self._folder / key / "map.json"),
        )  # fmt: skip
        return [self._shown(key) for key in keys], following

    def _shown(self, key: str) -> dict[str, Any]:
        if key in self._named:
            return self._named[key].to_json()
        shown: dict[str, Any] = files.read_json(self._folder / key / "map.json")["shown"]
        return shown

    def _read(self, id: str) -> Map:
        folder = self._folder / id
        grid = load_map((folder / "map.yaml").read_text(), (folder / "map.pgm").read_bytes())
        return Map(id, grid, parse_regions(self._shown(id)["rooms"]))


def _shipped(folder: Path) -> Iterator[Map]:
    """The maps of a folder: <name>.yaml, its image, and <name>.regions.json where areas have names."""
    for path in sorted(folder.glob("*.yaml")):
        try:
            image = next(
                path.with_suffix(kind) for kind in (".pgm", ".png") if path.with_suffix(kind).is_file()
            )
            grid = load_map(path.read_text(), image.read_bytes())
            named = path.with_suffix(".regions.json")
            areas = files.read_json(named) if named.is_file() else {}
            rooms = parse_regions({**areas.get("rooms", {}), **areas.get("regions", {})})
        except (SpecshieldError, StopIteration, ValueError) as error:
            log.warning("map %s is left out: %s", path, error or "no image beside it")
            continue
        yield Map(_id(grid, rooms), grid, rooms, path.stem)


def _id(grid: OccupancyGrid, rooms: Mapping[str, Region]) -> str:
    """The hash of what a map holds: the grid's own where no area has a name."""
    if not rooms:
        return grid.content_hash
    content = grid.content_hash.encode() + files.to_json(dict(sorted(_rooms_json(rooms).items())))
    return hashlib.sha256(content).hexdigest()


def _rooms_json(rooms: Mapping[str, Region]) -> dict[str, Any]:
    return {name: region_to_json(room) for name, room in rooms.items()}
