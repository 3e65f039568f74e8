"""The archive: files of sessions that have left the store, one file for each state of a session.

    <owner>@/<first 8 characters of the id>/<id>/<changes>,<beginning>,<expires>

A session's key is `owner@id`, as in the store. `changes` is the number of writes to the session, and
`beginning` differs for two sessions of one id. So a file never changes, and a late writer never replaces a
newer file. `expires` is in 1 / 4096 s since 1970, in hexadecimal. Older versions wrote whole seconds, in nine
digits; they read the files of this one, which to them never expire. A file has a head (config, state) and a
body (rows, steps), each packed with msgpack and compressed with zstandard. All calls block.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import zstandard

from specshield.errors import SessionDamaged
from specshield.service.storage.objects import Objects, left_out
from specshield.service.storage.store import Dump, scoped

MAGIC = b"specshield session 1\n"
FOLDER = 8  # characters of an id that name its folder; ids that the server makes in one minute share them
LEVEL = 3  # of zstandard; see docs/scale.md for what it costs
NAME = re.compile(r"([0-9a-f]{8,16}),([0-9a-f]+),([0-9a-f]{9,16})")
MOST = 1 << 32  # bytes that a head or a body may have; what says it has more is damaged
FIRST = 8192  # bytes that are read first: most heads lie within them
HEAD = msgspec.msgpack.Decoder(tuple[bytes, bytes, bytes])
BODY = msgspec.msgpack.Decoder(tuple[bytes, list[bytes]])
DAMAGED = (ValueError, zstandard.ZstdError)  # raised for a file that is damaged, or not of the archive


@dataclass(frozen=True, order=True)
class Entry:
    """One file. until: when it is erased, in the digits of the file's name."""

    key: str
    changes: int
    beginning: str
    until: str

    @staticmethod
    def of(key: str, name: str) -> Entry | None:
        """None for a name that is not of the form that `path` gives."""
        match = NAME.fullmatch(name)
        if match is None:
            return None
        changes, beginning, until = match.groups()
        return Entry(key, int(changes, 16), beginning, until)

    @property
    def expires(self) -> float:
        """When it is erased [s since 1970]."""
        return int(self.until, 16) / (1 if len(self.until) == 9 else 16**3)

    @property
    def path(self) -> str:
        return f"{_folder(self.key)}/{self.changes:08x},{self.beginning},{self.until}"


class Archive:
    def __init__(self, objects: Objects) -> None:
        self._objects = objects

    def put(self, key: str, expires: float, dump: Dump) -> tuple[Entry, int]:
        """Writes a session's file, which survives a power cut once this returns. Returns its entry, and the
        number of bytes that were written: 0 if the file existed already.
        """
        beginning, _, changes = dump.version.decode().partition(":")
        entry, content = Entry(key, int(changes), beginning, f"{int(expires * 16**3):x}"), pack(dump)
        if self._objects.read(entry.path) == content:
            return entry, 0
        self._objects.write(entry.path, content)
        return entry, len(content)

    def entries(self, key: str) -> list[Entry]:
        """All files of a session, the latest last; also those that have expired."""
        found = [Entry.of(key, name) for name in self._objects.names(_folder(key))]
        return sorted(entry for entry in found if entry is not None)

    def find(self, key: str) -> Entry | None:
        """The latest file of a session that has not expired."""
        kept = [entry for entry in self.entries(key) if entry.expires > time.time()]
        return kept[-1] if kept else None

    def read(self, entry: Entry) -> Dump | None:
        """The session in a file; None if it was removed meanwhile. Raises SessionDamaged, and a line of the
        log says so once.
        """
        content = self._objects.read(entry.path)
        try:
            return None if content is None else unpack(content)
        except DAMAGED as error:
            left_out(told := _damaged(entry, error))
            raise SessionDamaged(
                told, expected="the file as it was, from a backup, or a new session"
            ) from error

    def head(self, entry: Entry) -> tuple[bytes, bytes] | None:
        """(config, state), without reading the rest of the file. None if it was removed meanwhile or is
        damaged: a line of the log says so, and the owner's other sessions can still be listed.
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

    def erase(self, key: str, before: Entry | None = None) -> int:
        """Removes the files of a session, all of them or those that are older. Returns their bytes."""
        gone = 0
        for path, size in self._objects.sizes(_folder(key)):
            entry = Entry.of(key, path.rpartition("/")[2])
            if entry is not None and (before is None or entry < before):
                self.remove(entry)
                gone += size
        return gone

    def after(self, owner: str, id: str | None) -> Iterator[Entry]:
        """The latest file of each session of an owner that has not expired, in order of id, after this id."""
        folder = scoped(owner, "")
        for part in self._objects.names(folder):
            if id is not None and part < id[:FOLDER]:
                continue
            for found in self._objects.names(f"{folder}/{part}"):
                if (id is None or found > id) and (entry := self.find(folder + found)) is not None:
                    yield entry

    def sizes(self) -> Iterator[tuple[Entry, int]]:
        """All files, each with its bytes."""
        for path, size in self._objects.sizes(""):
            folder, *parts = path.split("/")
            entry = Entry.of(folder + parts[1], parts[2]) if len(parts) == 3 else None
            if entry is not None and entry.path == path:
                yield entry, size


def pack(dump: Dump) -> bytes:
    """The content of a file, which is the same for the same session and version."""
    head = _compressed([dump.config, dump.state, dump.version])
    return MAGIC + len(head).to_bytes(4, "little") + head + _compressed([dump.rows, dump.steps])


def unpack(content: bytes) -> Dump:
    """The session that `pack` was given. Raises one of DAMAGED for other content."""
    rows, steps = BODY.decode(_decompressed(content[_bounds(content)[1] :]))
    return Dump(*_head(content), rows, steps)


def _head(content: bytes) -> tuple[bytes, bytes, bytes]:
    start, end = _bounds(content)
    return HEAD.decode(_decompressed(content[start:end]))


def _bounds(content: bytes) -> tuple[int, int]:
    """Where the head begins and ends."""
    start = len(MAGIC) + 4
    if content[: len(MAGIC)] != MAGIC or len(content) < start:
        raise ValueError("it is not a file that this version of specshield wrote")
    return start, start + int.from_bytes(content[len(MAGIC) : start], "little")


def _compressed(value: object) -> bytes:
    packed = msgspec.msgpack.encode(value)
    return zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compress(packed)


def _decompressed(content: bytes) -> bytes:
    if zstandard.frame_content_size(content) > MOST:
        raise ValueError(f"it holds more than {MOST} bytes")
    return zstandard.ZstdDecompressor().decompress(content, allow_extra_data=False)


def _damaged(entry: Entry, error: Exception) -> str:
    return f"the file {entry.path} of the archive cannot be read: {error}"


def _folder(key: str) -> str:
    owner, _, id = key.rpartition("@")
    return f"{scoped(owner, '')}/{id[:FOLDER]}/{id}"
