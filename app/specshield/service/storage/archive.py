"""What sessions leave in files once the store has let go of them: one file for each state of one session.

    <owner>@/<first 8 characters of the id>/<id>/<changes>,<beginning>,<expires>

A session's key is `owner@id`, as in the store; the folder of keys without an owner is `_`. `changes` counts
the writes that the session has seen and `beginning` tells two sessions of one id apart, so a file never
changes, and a writer that comes late harms none that is newer. A file is a head (config, state) and a body
(rows, steps), each packed with msgpack and compressed with zstandard. Blocking.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import zstandard

from specshield.errors import StoreError
from specshield.service.storage.objects import Objects, left_out
from specshield.service.storage.store import Dump

MAGIC = b"specshield session 1\n"
PLAIN = "_"
FOLDER = 8  # characters of an id that name its folder: in ids that the server makes up, those of one minute
LEVEL = 3  # of zstandard; see docs/scale.md for what it costs
NAME = re.compile(r"([0-9a-f]{8,16}),([0-9a-f]+),([0-9a-f]{9,16})")
FIRST = 8192  # bytes that are read to see a head, which is one read for most
HEAD = msgspec.msgpack.Decoder(tuple[bytes, bytes, bytes])
BODY = msgspec.msgpack.Decoder(tuple[bytes, list[bytes]])
DAMAGED = (ValueError, zstandard.ZstdError)  # what reading raises of a file that is not whole, or not ours


@dataclass(frozen=True, order=True)
class Entry:
    """One file. expires: when it is erased [s since 1970]."""

    key: str
    changes: int
    beginning: str
    expires: int

    @staticmethod
    def of(key: str, name: str) -> Entry | None:
        """None where the name is not one that `path` makes."""
        match = NAME.fullmatch(name)
        if match is None:
            return None
        changes, beginning, expires = match.groups()
        return Entry(key, int(changes, 16), beginning, int(expires, 16))

    @property
    def path(self) -> str:
        return f"{_folder(self.key)}/{self.changes:08x},{self.beginning},{self.expires:09x}"


class Archive:
    def __init__(self, objects: Objects) -> None:
        self._objects = objects

    def put(self, key: str, expires: float, dump: Dump) -> tuple[Entry, int]:
        """Keeps a session; when this returns it outlives a power cut. The file, and the bytes that were
        written: 0 where it was there before.
        """
        beginning, _, changes = dump.version.decode().partition(":")
        entry, content = Entry(key, int(changes), beginning, int(expires) + 1), pack(dump)
        if self._objects.read(entry.path) == content:
            return entry, 0
        self._objects.write(entry.path, content)
        return entry, len(content)

    def entries(self, key: str) -> list[Entry]:
        """Every file of a session, the latest last, also those that have expired."""
        found = [Entry.of(key, name) for name in self._objects.names(_folder(key))]
        return sorted(entry for entry in found if entry is not None)

    def find(self, key: str) -> Entry | None:
        """The latest state that is kept of a session."""
        kept = [entry for entry in self.entries(key) if entry.expires > time.time()]
        return kept[-1] if kept else None

    def read(self, entry: Entry) -> Dump | None:
        """None where it was removed meanwhile. Raises StoreError for a file that is not one of ours."""
        content = self._objects.read(entry.path)
        try:
            return None if content is None else unpack(content)
        except DAMAGED as error:
            raise StoreError(_damaged(entry, error)) from error

    def head(self, entry: Entry) -> tuple[bytes, bytes] | None:
        """(config, state) without reading the rest; None where it was removed meanwhile, and for a file that
        is not one of ours: only the log tells of that, since the owner's other sessions can be listed.
        """
        content = self._objects.read(entry.path, 0, FIRST)
        try:
            if content is not None and (end := _bounds(content)[1]) > len(content):
                content += self._objects.read(entry.path, len(content), end) or b""
            return None if content is None else _head(content)[:2]
        except DAMAGED as error:
            left_out(_damaged(entry, error))
            return None

    def remove(self, entry: Entry) -> None:
        self._objects.remove(entry.path)

    def erase(self, key: str) -> bool:
        """Removes every file of a session; False where there was none."""
        found = self.entries(key)
        for entry in found:
            self.remove(entry)
        return bool(found)

    def after(self, owner: str, id: str | None) -> Iterator[Entry]:
        """The latest state of each session of an owner, in order of id, from after this id on.

        owner: what comes before the id in a key, as in `alice@`.
        """
        now = time.time()
        for part in self._objects.names(owner or PLAIN):
            if id is not None and part < id[:FOLDER]:
                continue
            for found in self._objects.names(f"{owner or PLAIN}/{part}"):
                if id is None or found > id:
                    yield from [e for e in self.entries(owner + found) if e.expires > now][-1:]

    def sizes(self) -> Iterator[tuple[Entry, int]]:
        """Every file there is, and its bytes."""
        for path, size in self._objects.sizes(""):
            owner, *parts = path.split("/")
            key = ("" if owner == PLAIN else owner) + parts[1] if len(parts) == 3 else ""
            entry = Entry.of(key, parts[2]) if key else None
            if entry is not None and entry.path == path:
                yield entry, size


def pack(dump: Dump) -> bytes:
    """The content of a file: the same for the same session and version."""
    head = _compressed([dump.config, dump.state, dump.version])
    return MAGIC + len(head).to_bytes(4, "little") + head + _compressed([dump.rows, dump.steps])


def unpack(content: bytes) -> Dump:
    """Raises one of DAMAGED where the content is not what `pack` made."""
    rows, steps = BODY.decode(_decompressed(content[_bounds(content)[1] :]))
    return Dump(*_head(content), rows, steps)


def _head(content: bytes) -> tuple[bytes, bytes, bytes]:
    start, end = _bounds(content)
    return HEAD.decode(_decompressed(content[start:end]))


def _bounds(content: bytes) -> tuple[int, int]:
    """Where the head begins and ends."""
    start = len(MAGIC) + 4
    if content[: len(MAGIC)] != MAGIC or len(content) < start:
        raise ValueError("it is not one that this version of specshield wrote")
    return start, start + int.from_bytes(content[len(MAGIC) : start], "little")


def _compressed(value: object) -> bytes:
    packed = msgspec.msgpack.encode(value)
    return zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compress(packed)


def _decompressed(content: bytes) -> bytes:
    return zstandard.ZstdDecompressor().decompress(content, allow_extra_data=False)


def _damaged(entry: Entry, error: Exception) -> str:
    return f"the file {entry.path} of the archive cannot be read: {error}"


def _folder(key: str) -> str:
    owner, at, id = key.rpartition("@")
    return f"{owner + at or PLAIN}/{id[:FOLDER]}/{id}"
