"""The files of maps and policies, which all servers of a store share: each under the hash of its content."""

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

from specshield.errors import InputError, InsufficientStorage
from specshield.service.settings import Settings
from specshield.service.storage.objects import Folder, open_objects, unusable

MARK = {"maps": "map.json", "policies": "policy.json"}
HASH = re.compile(r"[0-9a-f]{64}")
PAGE_BYTES = 256 << 10  # chosen by hand: read and shown in a few ms
BEHIND_A_URL = 4 << 10  # [bytes] as which a page counts what is there, whose size would take long to ask
V = TypeVar("V")


class Kept:
    """All `maps`, or all `policies`: a folder each, of files that never change once they are there. The mark
    is written last and removed first: it says that a folder is there at all.

    Methods raise StoreError where the files cannot be reached, and InsufficientStorage for a full disk.
    root: the folder on a disk of this machine; that of its copies where the files are behind a URL.
    """

    def __init__(self, settings: Settings, kind: str) -> None:
        objects, copies = open_objects(f"{settings.files_at}/{kind}"), settings.data_dir / "copies" / kind
        self._here = objects if isinstance(objects, Folder) else Folder(copies)
        self._objects, self._copies = objects, self._here is not objects
        self._mark, self.root = MARK[kind], self._here.root

    def find(self, id: str, name: str) -> Any:
        """What a file of JSON holds; None where it is not there, or no more."""
        content = self._objects.read(f"{id}/{name}")
        if content is None and name == self._mark and self._copies:
            shutil.rmtree(self.root / id, ignore_errors=True)  # another server has removed it
        return None if content is None else json.loads(content)

    def file(self, id: str, name: str) -> Path:
        """A file on a disk of this machine: it itself, or a copy that is made now."""
        path = self.root / id / name
        if self._copies and not path.exists():
            content = self._objects.read(f"{id}/{name}")
            if content is not None:
                self._here.write(f"{id}/{name}", content)
        return path

    def size(self, id: str, *names: str) -> int:
        """About as many bytes as reading these files takes."""
        return BEHIND_A_URL if self._copies else sum(size(self.root / id / name) for name in names)

    def write(self, id: str, files: Mapping[str, bytes]) -> None:
        # Weights before the card that makes them count.
        for name in sorted(files, key=lambda name: (name == self._mark, name.endswith(".json"), name)):
            self._objects.write(f"{id}/{name}", files[name])

    def remove(self, id: str) -> None:
        self._objects.remove(f"{id}/{self._mark}")
        shutil.rmtree(self.root / id, ignore_errors=True)  # with what a training has left there
        for name in self._objects.names(id):
            self._objects.remove(f"{id}/{name}")

    def weight(self, id: str) -> int:
        """Bytes that the files take; 0 where there are none."""
        return sum(size for path, size in self._objects.sizes(id) if path.count("/") == 1)


def check_writable(folder: Path, name: str) -> None:
    """Makes the folder if need be. Raises InputError, with its setting's name, where it takes no files or
    cannot be listed.
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
    """Raises InsufficientStorage where the disk of `folder` has fewer free bytes. One system call."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise unusable(error) from error
    if free < wanted:
        expected = f"at least {wanted} bytes free: delete something"
        raise InsufficientStorage("the server's disk is full", got=free, expected=expected)


def page(
    keys: Sequence[str], after: str | None, limit: int, size: Callable[[str], int]
) -> tuple[list[str], str | None]:
    """The first `limit` keys after `after`, in order, and the `after` of the next page, None on the last.

    size: about as many bytes as reading a key's item takes; no page takes many more than `PAGE_BYTES`.
    """
    rest = sorted(key for key in keys if after is None or key > after)
    taken, room = 0, PAGE_BYTES
    while taken < min(limit, len(rest)) and room > 0:
        room -= size(rest[taken])
        taken += 1
    return rest[:taken], rest[taken - 1] if len(rest) > taken else None


def size(path: Path) -> int:
    """Bytes; 0 where there is no such file."""
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
    """Keeps the values that were used last: `room` of them, or with `size` those that come to `room`. Threads
    may share it; two of them may make one value at once.
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
        """The value, if it is kept. Asking counts as a use of it."""
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
