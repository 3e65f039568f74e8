"""The maps of a server: those in `maps/`, which have names, and those that were sent, in `<data>/maps/<id>/`.

Such a folder has `map.yaml` and `map.png`, in map_server's form with one bit for each cell (older folders
have `map.pgm`), and `map.json`: the map as the contract shows it.
"""

from __future__ import annotations

import hashlib
import io
import logging
import secrets
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from PIL import Image

from specshield.errors import InUse, MapError, NotFound, SpecshieldError
from specshield.map_files import read_map_files
from specshield.service.access.keys import Key
from specshield.service.library import files
from specshield.service.library.claims import Claimed, Claims, missing
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
        """The cells as an image: black is occupied, and row 0 of the image is the map's highest y."""
        buffer = io.BytesIO()
        Image.fromarray(~self.grid.occupied[::-1]).save(buffer, "PNG")
        return buffer.getvalue()


class Maps(Claimed):
    """All calls block: they read and write files."""

    def __init__(self, settings: Settings, claims: Claims | None = None) -> None:
        super().__init__("maps", claims, settings)
        self._recent = files.Recent[Map](KEPT_IN_MEMORY)
        self._named: Mapping[str, Map] = {str(found.name): found for found in _shipped(settings.maps_dir)}

    def get(self, key: str) -> Map:
        """A map by its id, whoever owns it, or one that came with the server. Raises NotFound."""
        found = self.shipped(key)
        if found is not None:
            return found
        stored = self._stored(key)
        return self._recent.get(key, lambda: self._read(key, stored))

    def shipped(self, key: str) -> Map | None:
        """A map that came with the server, by its id, its name, or the hash of its grid."""
        for found in self._named.values():
            if key in (found.name, found.id, found.grid.content_hash):
                return found
        return None

    def find(self, key: str, owner: str) -> Map:
        """A map that this owner may use, by its id, its name, or the hash of its grid alone, which policies'
        cards have. Raises NotFound.
        """
        found = self.shipped(key)
        if found is not None:
            return found
        key = self._id_of(key, owner)
        if files.HASH.fullmatch(key):
            if self.claims.holds("maps", key, owner):
                return self.get(key)
            for id in self.claims.ids("maps", owner):
                with suppress(NotFound):  # deleted at this moment
                    if self._stored(id)["grid"] == key:
                        return self.get(id)
        raise missing("maps", key)

    def show(self, key: str, owner: str) -> dict[str, Any]:
        """A map as the contract shows it, mostly without reading its cells. Raises NotFound."""
        if self.shipped(key) is not None:
            return self.find(key, owner).to_json()
        id = self._id_of(key, owner)
        shown = self._shown(id) if self.claims.holds("maps", id, owner) else self.find(id, owner).to_json()
        return {**shown, "name": self.claims.name_of("maps", shown["id"], owner)}

    def add(self, grid: OccupancyGrid, rooms: Mapping[str, Region], key: Key, name: str | None = None) -> Map:
        """Keeps a map for the owner of the key, under a name if one is given. Raises MapError for rooms whose
        names no formula could use, LimitReached, InsufficientStorage and NameTaken.
        """
        parse_regions(rooms, "rooms")
        id = _id(grid, rooms)
        found = self.shipped(id)
        if name is not None:
            self.check_name(name, id if found is None else found.id, key.name)
        if found is not None:
            return found
        if len(files.to_json(_rooms_json(rooms))) > (most := self._settings.max_spec_bytes):
            raise MapError(
                "the outlines of the rooms are too large",
                path="rooms",
                expected=f"at most {most} bytes as JSON: simpler outlines",
            )
        made = Map(id, grid, rooms)
        meta = files.to_json({"grid": grid.content_hash, "shown": made.to_json()})
        content = {"map.yaml": dump_map(grid)[0].encode(), "map.png": made.png(), "map.json": meta}
        with self.claims.adding("maps", id, key, sum(map(len, content.values()))):
            if self._kept.find(id, "map.json") is None:
                self._kept.write(id, content)
        if name is not None:
            self.claims.name("maps", id, key.name, name)
        kept = self._recent.get(id, lambda: made)
        return replace(kept, name=self.claims.name_of("maps", id, key.name))

    def delete(self, key: str, owner: str) -> None:
        """Removes a map for an owner, and its files with the last one. Raises NotFound, InUse, Conflict."""
        found = self.shipped(key)
        if found is not None:
            raise undeletable("map", found.name, key)
        key, token = self._id_of(key, owner), secrets.token_hex(8)
        if files.HASH.fullmatch(key):
            self._kept.check_removable(key)
        user = self.claims.mark("maps", key, owner, token)
        if user is not None:
            raise InUse(
                f"policy {user!r} is for this map",
                path="map_id",
                got=key,
                expected="a map that no policy is for: delete the policy first",
                policy_id=user,
            )
        try:
            if self.claims.free("maps", key, owner, token):
                self._recent.drop(key)
                self._kept.remove(key)
        finally:
            self.claims.unmark("maps", key, token)

    def page(self, owner: str, after: str | None, limit: int) -> tuple[list[dict[str, Any]], str | None]:
        """One page of the maps that an owner may use, as the contract shows them, without reading cells."""
        keys = [*self._named, *self.claims.ids("maps", owner)]
        keys, following = files.page(keys, after, limit, lambda key: self._kept.size(key, "map.json"))
        names, shown = self.claims.names("maps", owner), []
        for key in keys:
            with suppress(NotFound):  # deleted at this moment, or not written to the end
                shown.append(self._shown(key) | ({"name": names[key]} if key in names else {}))
        return shown, following

    def _shown(self, key: str) -> dict[str, Any]:
        if key in self._named:
            return self._named[key].to_json()
        shown: dict[str, Any] = self._stored(key)["shown"]
        return shown

    def _stored(self, id: str) -> dict[str, Any]:
        """The content of a map's map.json. Raises NotFound if there is none."""
        found: dict[str, Any] | None = self._kept.find(id, "map.json") if files.HASH.fullmatch(id) else None
        if found is None:
            raise missing("maps", id)
        return found

    def _read(self, id: str, stored: Mapping[str, Any]) -> Map:
        rooms = parse_regions(stored["shown"]["rooms"], "rooms")
        try:
            images = (self._kept.file(id, f"map.{kind}") for kind in ("png", "pgm"))
            image = next(path for path in images if path.is_file())
            return Map(id, load_map(self._kept.file(id, "map.yaml").read_text(), image.read_bytes()), rooms)
        except (FileNotFoundError, StopIteration):
            raise missing("maps", id) from None


def undeletable(what: str, name: str | None, key: str) -> InUse:
    """The error for deleting a map or policy (`what`) that came with the server."""
    message, expected = f"{what} {name!r} came with the server and cannot be deleted", f"a {what} of your own"
    return InUse(message, path=f"{what}_id", got=key, expected=expected)


def _shipped(folder: Path) -> Iterator[Map]:
    """The maps of a folder: <name>.yaml, its image, and <name>.regions.json where areas have names."""
    for path in sorted(folder.glob("*.yaml")):
        try:
            grid, rooms = read_map_files(path)
        except SpecshieldError as error:
            log.warning("map %s is left out: %s", path, error)
            continue
        yield Map(_id(grid, rooms), grid, rooms, path.stem)


def _id(grid: OccupancyGrid, rooms: Mapping[str, Region]) -> str:
    """The hash of a map's grid and of its named areas; without these it is the hash of the grid."""
    if not rooms:
        return grid.content_hash
    content = grid.content_hash.encode() + files.to_json(dict(sorted(_rooms_json(rooms).items())))
    return hashlib.sha256(content).hexdigest()


def _rooms_json(rooms: Mapping[str, Region]) -> dict[str, Any]:
    return {name: region_to_json(room) for name, room in rooms.items()}
