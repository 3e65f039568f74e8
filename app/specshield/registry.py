"""Methods, map formats and preferences by name: those of the project, and those that other packages add.

A package adds one as an entry point. For a method of its own, `pyproject.toml` says

    [project.entry-points."specshield.methods"]
    sweep = "my_package.sweep:METHOD"

and once the package is installed, `sweep` can be named wherever `planner` can. A module is imported when its
entry is first asked for.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

from specshield.errors import InputError, Unsupported

E = TypeVar("E")
log = logging.getLogger("specshield")


class Registry(Generic[E]):
    """Entries of one type by name.

    word: what one entry is called in messages. cls: the type of the entries. group: of the entry points that
    add entries. built_in: where each entry of the project is, as "module:attribute". field: the field of a
    request that names an entry; by default the word.
    """

    def __init__(
        self, word: str, cls: type[E], group: str, built_in: Mapping[str, str], field: str | None = None
    ) -> None:
        self.word, self._cls, self._group, self._built_in = word, cls, group, built_in
        self._field = field or word
        self._loaded: dict[str, E] = {}

    @cached_property
    def _points(self) -> dict[str, EntryPoint]:
        """The entry points by name. A name that the project uses itself stays the project's."""
        own = {name: EntryPoint(name, where, self._group) for name, where in self._built_in.items()}
        added = {point.name: point for point in entry_points(group=self._group)}
        for name in own.keys() & added.keys():
            log.warning("%s %r of %s is left out: specshield has one", self.word, name, _origin(added[name]))
        return added | own

    def names(self) -> list[str]:
        """The names there are, sorted, whether or not what they name can be loaded."""
        return sorted(self._points)

    def get(self, name: str) -> E:
        """The entry of this name.

        Raises InputError where there is none, with the names there are, and Unsupported where the package
        that adds it is broken; the log then holds the cause.
        """
        if name not in self._points:
            expected = f"one of {', '.join(self.names())}"
            raise InputError(f"unknown {self.word}", path=self._field, got=name, expected=expected)
        if name not in self._loaded:
            self._loaded[name] = self._load(self._points[name])
        return self._loaded[name]

    def usable(self) -> Iterator[tuple[str, E]]:
        """Every entry that can be loaded, with its name, in order of name."""
        for name in self.names():
            with suppress(Unsupported):  # the log says why
                yield name, self.get(name)

    def _load(self, point: EntryPoint) -> E:
        what = f"the {self.word} {point.name!r} of {_origin(point)}"
        try:
            entry = point.load()
            if not isinstance(entry, self._cls):
                raise TypeError(f"{point.value} is a {type(entry).__name__}, not a {self._cls.__name__}")
        except Exception as error:  # importing a module can raise anything
            log.exception("%s cannot be loaded", what)
            told = f"{what} cannot be loaded: {type(error).__name__}; the log says more"
            expected = f"a {self.word} whose package is whole"
            raise Unsupported(told, path=self._field, got=point.name, expected=expected) from error
        return entry


def _origin(point: EntryPoint) -> str:
    return f"package {point.dist.name!r}" if point.dist is not None else "specshield"
