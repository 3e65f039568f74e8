"""Files that several machines share, in a folder or at an fsspec URL. Readers see whole files only."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import secrets
import time
from collections.abc import Callable, Iterator
from errno import EDQUOT, ELOOP, ENOSPC
from functools import lru_cache, wraps
from pathlib import Path
from stat import S_ISDIR
from typing import Any, ParamSpec, TypeVar, cast

from specshield.errors import InputError, InsufficientStorage, SpecshieldError, StoreError

P = ParamSpec("P")
R = TypeVar("R")
DRAFT = ".draft-"  # how the name of an incomplete file begins; names that begin with a dot are not listed
LEFT = 3600  # [s] after which nobody will complete a draft
TRIES = 10  # to make a folder that another process removes because it is empty
ABSENT = (FileNotFoundError, IsADirectoryError, NotADirectoryError)
log = logging.getLogger("specshield")


def open_objects(place: str) -> Objects:
    """The files in a folder or at an fsspec URL. Raises InputError if no installed package reads the URL."""
    try:
        if "://" not in place:
            return Folder(Path(place))
        from fsspec.core import url_to_fs

        files, root = url_to_fs(place, use_listings_cache=False, skip_instance_cache=True)
        return Folder(Path(root)) if type(files).__name__ == "LocalFileSystem" else Remote(files, root)
    except (ImportError, ValueError, OSError) as error:  # OSError: the server of the URL cannot be reached
        raise InputError(
            f"files at {without_password(place)!r} cannot be used: {error}",
            expected="a folder, or a URL such as s3://bucket/prefix with the package that reads it (s3fs)",
        ) from None


def without_password(place: str) -> str:
    """The place for logs and answers.

    >>> without_password("ftp://robot:secret@host/files")
    'ftp://host/files'
    """
    return re.sub(r"(?<=://)[^/]*@", "", place)


def _reaching(absent: Callable[[], Any] | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Turns a method's OSError into a SpecshieldError. absent: makes the result if the file is not there."""

    def decorate(method: Callable[P, R]) -> Callable[P, R]:
        @wraps(method)
        def reach(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return method(*args, **kwargs)
            except OSError as error:
                missing = isinstance(error, ABSENT) or error.errno == ELOOP
                if absent is not None and missing and cast(Any, args[0]).there():
                    return cast(R, absent())
                raise unusable(error) from error

        return reach

    return decorate


def unusable(error: OSError) -> SpecshieldError:
    """The error for callers, InsufficientStorage for a full disk. Only the log names the file."""
    if error.errno in (ENOSPC, EDQUOT):
        return InsufficientStorage("the server's disk is full", expected="a disk with room")
    log.warning("%s", error)
    return StoreError(f"the server's files cannot be used: {error.strerror or type(error).__name__}")


class Folder:
    """A folder of this machine, or one that several machines mount. Paths are relative, with `/`. Every
    method raises StoreError if the files cannot be reached, and InsufficientStorage for a full disk.
    """

    def __init__(self, root: Path) -> None:
        root.mkdir(parents=True, exist_ok=True)
        self.root = root

    def there(self) -> bool:
        """Whether the folder itself is there. If a network folder is away, no file is known to be absent."""
        return os.path.isdir(self.root)

    @_reaching(absent=lambda: None)
    def read(self, path: str, start: int = 0, end: int | None = None) -> bytes | None:
        """The bytes from `start` to before `end`; None if there is no such file."""
        with open(self.root / path, "rb") as file:
            file.seek(start)
            return file.read(-1 if end is None else end - start)

    @_reaching()
    def write(self, path: str, content: bytes) -> None:
        """Writes the file, or replaces it. Once this returns, the file survives a power cut."""
        target = self.root / path
        draft = target.with_name(f"{DRAFT}{secrets.token_hex(8)}")
        for left in reversed(range(TRIES)):
            made = [folder for folder in target.parents if not folder.exists()]
            try:
                self.root.stat()  # fails if a network folder is away: mkdir would make a local one
                target.parent.mkdir(parents=True, exist_ok=True)
                write_through(draft, content)
                os.replace(draft, target)
                for folder in (target.parent, *(folder.parent for folder in made)):
                    sync(folder)
                return
            except FileNotFoundError:
                if not left:
                    raise
            finally:
                draft.unlink(missing_ok=True)

    @_reaching()
    def remove(self, path: str) -> None:
        """Removes the file if it is there, and the folders that are empty then."""
        target = self.root / path
        self.root.stat()  # fails if a network folder is away: its file would come back with it
        target.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # the folder is not empty, or gone already
            for folder in target.parents:
                if folder == self.root:
                    break
                folder.rmdir()

    @_reaching(absent=list)
    def names(self, folder: str) -> list[str]:
        """The sorted names of what lies directly in a folder; none if there is no such folder."""
        return sorted(name for name in os.listdir(self.root / folder) if not name.startswith("."))

    def sizes(self, folder: str) -> Iterator[tuple[str, int]]:
        """(path, bytes) of every file below a folder, in order of path."""
        here = self.root / folder
        try:
            about = here.stat()
            if here.name.startswith(DRAFT) and about.st_mtime < time.time() - LEFT:
                here.unlink()  # it is from a process that was killed
            elif here.is_symlink() and any(map(here.samefile, here.parents)):
                left_out(f"{here} is left out: it is a link to a folder that it lies in")
            elif S_ISDIR(about.st_mode) or not folder:
                for found in sorted(here.iterdir()):
                    yield from self.sizes(found.relative_to(self.root).as_posix())
            elif not here.name.startswith("."):
                yield folder, about.st_size
        except OSError as error:
            if not folder or not self.there():
                raise unusable(error) from error
            if not isinstance(error, FileNotFoundError):  # another process may remove it at any time
                left_out(f"{here} is left out: {error.strerror}")


class Remote:
    """Files of an fsspec file system, with the methods of `Folder`. Most such systems write whole files."""

    def __init__(self, files: Any, root: str) -> None:
        self._files, self._root = files, root.rstrip("/")

    def there(self) -> bool:
        """As of `Folder`. Such a file system says by an error that it is away."""
        return True

    @_reaching(absent=lambda: None)
    def read(self, path: str, start: int = 0, end: int | None = None) -> bytes | None:
        return bytes(self._files.cat_file(self._at(path), start=start or None, end=end))

    @_reaching()
    def write(self, path: str, content: bytes) -> None:
        place = self._at(path)
        self._files.makedirs(place.rpartition("/")[0], exist_ok=True)
        self._files.pipe_file(place, content)

    @_reaching(absent=lambda: None)
    def remove(self, path: str) -> None:
        self._files.rm_file(self._at(path))

    @_reaching(absent=list)
    def names(self, folder: str) -> list[str]:
        found = self._files.ls(self._at(folder), detail=False)
        return sorted({name.rstrip("/").rpartition("/")[2] for name in found} - {""})

    @_reaching()
    def sizes(self, folder: str) -> Iterator[tuple[str, int]]:
        below = self._files.find(self._at(folder), detail=True)
        skipped = len(self._at("")) + 1
        return iter(sorted((name[skipped:], int(about["size"])) for name, about in below.items()))

    def _at(self, path: str) -> str:
        return f"{self._root}/{path}".rstrip("/")


@lru_cache(1000)
def left_out(told: str) -> None:
    """Logs a warning about a file that is left out, once for the same text."""
    log.warning("%s", told)


Objects = Folder | Remote


def write_through(path: Path, content: bytes) -> None:
    """Writes a file. Its content is on the disk once this returns, its name after `sync` of the folder."""
    with open(path, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
