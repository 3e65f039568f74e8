"""The forms in which a map can be sent, by name.

To add one: a file that defines a `MapFormat`, and a line below (or an entry point of the group
`specshield.map_formats` in a package of its own).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from specshield.errors import InputError, MapError
from specshield.registry import Registry
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Region

Rooms = Mapping[str, Region]


@dataclass(frozen=True)
class MapFormat:
    """A form in which a map can be sent.

    about: what it is, in a sentence or two. members: the JSON schema of each member of a map in this form,
    by name; those with a `default` may be left out. files: whether the members are files (a multipart body)
    instead of members of a JSON object. parse: takes the members by name, files as bytes, and gives the grid
    with its rooms; raises MapError with the path of the member at fault. example: members that it takes.
    """

    about: str
    members: Mapping[str, Mapping[str, Any]]
    parse: Callable[..., tuple[OccupancyGrid, Rooms]]
    files: bool = False
    example: Mapping[str, Any] | None = None

    @property
    def required(self) -> list[str]:
        return [name for name, schema in self.members.items() if "default" not in schema]


FORMATS = Registry(
    "format",
    MapFormat,
    "specshield.map_formats",
    {
        "map_server": "specshield.world.map_server:FORMAT",
        "occupancy_grid": "specshield.world.nav_msgs:FORMAT",
        "procthor": "specshield.world.procthor:FORMAT",
    },
)


def read_map(name: Any, members: Mapping[str, Any], files: bool = False) -> tuple[OccupancyGrid, Rooms]:
    """The grid and the rooms of a map that was sent as `members` of the format `name`.

    files: whether they were sent as files. Raises InputError for a format that is unknown or was sent the
    wrong way, MapError for a member that is missing, unknown or wrong.
    """
    if name is None:
        said = "nothing says which format the map has"
        raise InputError(said, path="format", expected=f"one of {', '.join(FORMATS.names())}")
    format = FORMATS.get(str(name))
    if format.files != files:
        ways = {True: "files (multipart/form-data)", False: "a JSON object"}
        told = f"a map of the format {name} is not sent this way"
        expected = f"{ways[format.files]} with {' and '.join(format.required)}"
        raise InputError(told, path="format", got=ways[files], expected=expected)
    for member in format.required:
        if member not in members:
            expected = f"a member {member!r}, which belongs to the format {name}"
            raise MapError(f"{member} is missing", path=member, expected=expected)
    for member in members:
        if member not in format.members:
            told, known = f"the format {name} has no such member", ", ".join(sorted(format.members))
            raise MapError(told, path=str(member)[:200], got=member, expected=f"one of {known}")
    defaults = {member: schema["default"] for member, schema in format.members.items() if "default" in schema}
    return format.parse(**{**defaults, **members})
