"""Local copies of folders that all servers share behind an fsspec URL.

A folder holds files that never change once they are there: so a copy is brought up to date by fetching what
is missing. `MARK`, written last and removed first, says that a folder is there at all.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from specshield.service.storage.objects import Objects

MARK = {"maps": "map.json", "policies": "policy.json"}


class Mirror:
    """One kind of folders: `local` is this server's copy of `remote`/`kind`."""

    def __init__(self, local: Path, remote: Objects, kind: str) -> None:
        self._local, self._remote, self._kind, self._mark = local, remote, kind, MARK[kind]

    def missing(self, id: str, only: Sequence[str] = ()) -> dict[str, bytes] | None:
        """The files that the copy lacks, or those of `only`, the mark last; None where there is no such
        folder, or no more.
        """
        names = self._remote.names(f"{self._kind}/{id}")
        if self._mark not in names:
            shutil.rmtree(self._local / id, ignore_errors=True)
            return None
        found: dict[str, bytes] = {}
        for name in sorted(names, key=self._order):
            if (not only or name in only) and not (self._local / id / name).exists():
                content = self._remote.read(f"{self._kind}/{id}/{name}")
                if content is None:  # removed at this moment
                    return None
                found[name] = content
        return found

    def send(self, id: str, files: dict[str, bytes]) -> None:
        for name in sorted(files, key=self._order):
            self._remote.write(f"{self._kind}/{id}/{name}", files[name])

    def remove(self, id: str) -> None:
        for name in sorted(self._remote.names(f"{self._kind}/{id}"), key=self._order, reverse=True):
            self._remote.remove(f"{self._kind}/{id}/{name}")

    def _order(self, name: str) -> tuple[bool, bool, str]:
        """Weights before the card that makes them count, and the mark at the end."""
        return name == self._mark, name.endswith(".json"), name
