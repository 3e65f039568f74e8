"""Folders that several processes share: each appears whole, by rename, under the hash of its content."""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import secrets
import shutil
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Generic, TypeVar

from specshield.errors import InputError, InsufficientStorage, SpecshieldError, StoreError
from specshield.service.library.mirror import Mirror
from specshield.service.settings import Settings
from specshield.service.storage.objects import open_objects, sync, write_through

HASH = re.compile(r"[0-9a-f]{64}")
PAGE_BYTES = 256 << 10  # chosen by hand: read and shown in a few ms
V = TypeVar("V")
log = logging.getLogger("specshield")
_mirrors: dict[Path, Mirror] = {}  # of the folders whose things are behind a URL


def kept(settings: Settings, kind: str) -> Path:
    """The folder of all `maps` or `policies`; where they are behind a URL, that of this server's copies."""
    place = Path(settings.files_at) if "://" not in settings.files_at else settings.data_dir / "copies"
    folder = place / kind
    folder.mkdir(parents=True, exist_ok=True)
    if "://" in settings.files_at:
        _mirrors[folder] = Mirror(folder, open_objects(settings.files_at), kind)
    return folder


def there(folder: Path, *names: str) -> bool:
    """Whether a map or policy is there. A copy is brought up to date first: all of it, or these files."""
    mirror = _mirrors.get(folder.parent)
    if mirror is None:
        return folder.is_dir()
    missing = mirror.missing(folder.name, names)
    if missing is None:
        return False
    if not folder.is_dir():
        _write_folder(folder, missing)
    for name, content in missing.items():
        if not (folder / name).exists():  # another may have made the folder, with fewer files
            _write_file(folder / name, content)
    return True


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


def find_json(path: Path) -> Any:
    """None where there is no such file, or no more: another process may delete what this one looks at."""
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        return None


def to_json(value: Any) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()


def write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes all of the files, or none. A folder that is there already has the same content, and stays."""
    _write_folder(folder, files)
    if folder.parent in _mirrors:
        _mirrors[folder.parent].send(folder.name, dict(files))


def _write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    draft = Path(tempfile.mkdtemp(dir=folder.parent, prefix=".draft-"))
    try:
        for name, content in files.items():
            write_through(draft / name, content)
        os.rename(draft, folder)
        sync(folder.parent)
    except OSError:
        if not folder.is_dir():
            raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def weight_of(folder: Path) -> int:
    """Bytes that the files of a folder take; 0 where it is gone."""
    try:
        return sum(size(path) for path in folder.iterdir() if path.is_file())
    except FileNotFoundError:
        return 0


def write_file(path: Path, content: bytes) -> None:
    """Replaces the file as a whole: a reader sees the old one or the new one."""
    _write_file(path, content)
    if path.parent.parent in _mirrors:
        _mirrors[path.parent.parent].send(path.parent.name, {path.name: content})


def _write_file(path: Path, content: bytes) -> None:
    draft = path.with_name(f".draft-{secrets.token_hex(8)}")
    write_through(draft, content)
    os.replace(draft, path)
    sync(path.parent)


def remove_folder(folder: Path) -> None:
    """Takes the folder out of the others' sight at once, then erases it."""
    if folder.parent in _mirrors:
        _mirrors[folder.parent].remove(folder.name)
    grave = Path(tempfile.mkdtemp(dir=folder.parent, prefix=".deleted-"))
    if folder.is_dir():
        os.rename(folder, grave / folder.name)
    shutil.rmtree(grave, ignore_errors=True)


def check_free(folder: Path, wanted: int) -> None:
    """Raises InsufficientStorage where the disk of `folder` has fewer free bytes. One system call."""
    with guarded():
        free = shutil.disk_usage(folder).free
    if free < wanted:
        expected = f"at least {wanted} bytes free: delete something"
        raise InsufficientStorage("the server's disk is full", got=free, expected=expected)


@contextmanager
def guarded() -> Iterator[None]:
    """Files that cannot be used raise what `unusable` makes of it."""
    try:
        yield
    except OSError as error:
        raise unusable(error) from error


def unusable(error: OSError) -> SpecshieldError:
    """What a caller is told of it; which file it is, the log alone. A full disk is InsufficientStorage."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return InsufficientStorage("the server's disk is full", expected="a disk with room")
    log.warning("%s", error)
    return StoreError(f"the server's files cannot be used: {error.strerror}")


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
