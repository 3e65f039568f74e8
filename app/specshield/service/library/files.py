"""The files of maps and policies, which all servers of a store share, under the hashes of their content."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Generic, TypeVar

from specshield.errors import InputError, InsufficientStorage, StoreError
from specshield.service.settings import Settings
from specshield.service.storage.objects import Folder, open_objects, unusable

MARK = {"maps": "map.json", "policies": "policy.json"}
HASH = re.compile(r"[0-9a-f]{64}")
PAGE_BYTES = 256 << 10  # of items on a page of a list; chosen by hand: read and shown in a few ms
BEHIND_A_URL = 4 << 10  # [bytes] for which an item at a URL counts on a page: its size would take long to ask
V = TypeVar("V")


class Kept:
    """The files of all `maps`, or of all `policies`: a folder for each, whose files never change. One file,
    the mark, is written last and removed first: a folder without it does not count.

    Methods raise StoreError if the files cannot be reached, and InsufficientStorage for a full disk.
    root: the folder on a disk of this machine, with copies if the files are at a URL.
    """

    def __init__(self, settings: Settings, kind: str) -> None:
        objects, copies = open_objects(f"{settings.files_at}/{kind}"), settings.data_dir / "copies" / kind
        self._here = objects if isinstance(objects, Folder) else Folder(copies)
        self._objects, self._copies = objects, self._here is not objects
        self._mark, self.root = MARK[kind], self._here.root

    def find(self, id: str, name: str) -> Any:
        """The content of a JSON file; None if there is no such file."""
        content = self._objects.read(f"{id}/{name}")
        if content is None and name == self._mark and self._copies:
            shutil.rmtree(self.root / id, ignore_errors=True)  # another server has removed it
        return None if content is None else json.loads(content)

    def file(self, id: str, name: str) -> Path:
        """The path of a file on a disk of this machine: the file itself, or a copy that is made now."""
        path = self.root / id / name
        if self._copies and not path.exists():
            content = self._objects.read(f"{id}/{name}")
            if content is not None:
                self._here.write(f"{id}/{name}", content)
        return path

    def size(self, id: str, *names: str) -> int:
        """About how many bytes these files have."""
        return BEHIND_A_URL if self._copies else sum(size(self.root / id / name) for name in names)

    def write(self, id: str, files: Mapping[str, bytes]) -> None:
        # Weights are written before the card, which makes them count.
        for name in sorted(files, key=lambda name: (name == self._mark, name.endswith(".json"), name)):
            self._objects.write(f"{id}/{name}", files[name])

    def check_removable(self, id: str) -> None:
        """Raises StoreError if the files could not be removed: they would stay, and belong to nobody."""
        self.find(id, self._mark)
        if not self._copies and not os.access(self.root, os.W_OK):
            raise StoreError("the server's files cannot be removed: their folder cannot be written to")

    def remove(self, id: str) -> None:
        self._objects.remove(f"{id}/{self._mark}")
        shutil.rmtree(self.root / id, ignore_errors=True)  # with the checkpoints of a training
        for name in self._objects.names(id):
            self._objects.remove(f"{id}/{name}")

    def weight(self, id: str) -> int:
        """The bytes of all files of a thing; 0 if it has none."""
        return sum(size for path, size in self._objects.sizes(id) if path.count("/") == 1)


def check_writable(folder: Path, name: str) -> None:
    """Makes the folder if it does not exist. Raises InputError with the setting `name` if no file can be
    written there, or the folder cannot be listed.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
        os.scandir(folder).close()
    except OSError as error:
        told, expected = f"{name} cannot be used: {error.strerror}", "a folder to write to"
        raise InputError(told, path=name, got=str(folder), expected=expected) from error


def to_json(value: Any) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()


def check_free(folder: Path, wanted: int) -> None:
    """Raises InsufficientStorage if the disk of `folder` has fewer free bytes. Takes one system call."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise unusable(error) from error
    if free < wanted:
        expected = f"at least {wanted} free bytes, SPECSHIELD_DISK_RESERVE_BYTES included: delete something"
        raise InsufficientStorage(
            "the server's disk is full, apart from its reserve", got=free, expected=expected
        )


def page(
    keys: Sequence[str], after: str | None, limit: int, size: Callable[[str], int]
) -> tuple[list[str], str | None]:
    """The first `limit` keys after `after`, in order, and the `after` of the next page, None on the last.

    size: about how many bytes the item of a key has; a page has at most about `PAGE_BYTES` of them.
    """
    rest = sorted(key for key in keys if after is None or key > after)
    taken, room = 0, PAGE_BYTES
    while taken < min(limit, len(rest)) and room > 0:
        room -= size(rest[taken])
        taken += 1
    return rest[:taken], rest[taken - 1] if len(rest) > taken else None


def size(path: Path) -> int:
    """The bytes of a file; 0 if there is no such file."""
    try:
        return path.stat().st_size
    except OSError:
        return 0


def now() -> str:
    return rfc3339(datetime.now(timezone.utc).timestamp())


def rfc3339(seconds: float) -> str:
    at = datetime.fromtimestamp(seconds, timezone.utc)
    return at.isoformat(timespec="milliseconds").replace("+00:00", "Z")


class Recent(Generic[V]):
    """Keeps the values that were used last, as long as their sizes add up to at most `room`; by default each
    has size 1. Threads may share it; two of them may make the same value at the same time.
    """

    def __init__(self, room: int, size: Callable[[V], int] = lambda value: 1) -> None:
        self._room, self._size, self._used = room, size, 0
        self._values, self._lock = OrderedDict[Hashable, tuple[V, int]](), threading.Lock()

    def get(self, key: Hashable, make: Callable[[], V]) -> V:
        found = self.peek(key)
        if found is None:
            found = make()
            self.put(key, found)
        return found

    def peek(self, key: Hashable) -> V | None:
        """The value, if it is kept. This counts as a use of it."""
        with self._lock:
            if key not in self._values:
                return None
            self._values.move_to_end(key)
            return self._values[key][0]

    def put(self, key: Hashable, value: V) -> None:
        size = self._size(value)
        with self._lock:
            self._used += size - self._values.pop(key, (None, 0))[1]
            self._values[key] = value, size
            while self._used > self._room:
                self._used -= self._values.popitem(last=False)[1][1]

    def drop(self, key: Hashable) -> None:
        with self._lock:
            self._used -= self._values.pop(key, (None, 0))[1]
