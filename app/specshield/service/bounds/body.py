"""The body of a request that is being received: in memory while it is small, else in a file. A budget limits
all bodies together.
"""

from __future__ import annotations

import asyncio
import contextlib
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starlette.requests import Request

from specshield.errors import Busy

FREE = 64 << 10  # [bytes] of each body that the budget does not count, so that steps are always taken
IN_MEMORY = 1 << 20  # [bytes] of a body that are held in memory before they are written to its file


class Budget:
    """The bytes that the bodies of all requests together may have."""

    def __init__(self, limit: int) -> None:
        self._left = limit

    def take(self, size: int) -> None:
        """Raises Busy if so many bytes are not left."""
        if size > self._left:
            raise Busy(
                "the server cannot hold more bytes of requests now", expected="the request again in a while"
            )
        self._left -= size

    def give(self, size: int) -> None:
        self._left += size


@dataclass
class Body:
    """folder: for the file of a large body. `close` removes the file and gives the bytes back."""

    budget: Budget
    folder: Path
    content_type: str
    size: int = 0
    _held: bytearray = field(default_factory=bytearray)
    _file: Any = None

    async def add(self, chunk: bytes) -> None:
        """Raises Busy if the bodies of all requests together have too many bytes."""
        counted = max(self.size - FREE, 0)
        self.budget.take(max(self.size + len(chunk) - FREE, 0) - counted)
        self.size += len(chunk)
        self._held += chunk
        if len(self._held) > IN_MEMORY:
            await self._write()

    async def end(self) -> None:
        """To be called after the last `add`."""
        if self._file is not None:
            await self._write()
            self._file.flush()

    @property
    def content(self) -> bytes | Path:
        """The whole body, or the file that holds it."""
        return bytes(self._held) if self._file is None else Path(self._file.name)

    async def _write(self) -> None:
        if self._file is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._file = tempfile.NamedTemporaryFile(dir=self.folder)  # noqa: SIM115  it stays open until `close`
        held, self._held = self._held, bytearray()
        await asyncio.to_thread(self._file.write, held)

    def close(self) -> None:
        self.budget.give(max(self.size - FREE, 0))
        self.size = 0
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()  # which removes it


def received(request: Request) -> Body:
    """The body of an upload, which bodies.py has received."""
    body: Body = request.scope["state"]["body"]
    return body


def clear(folder: Path) -> None:
    """Removes files that are older than an hour: they are left from servers that were killed."""
    for path in folder.glob("*"):
        with contextlib.suppress(OSError):
            if path.stat().st_mtime < time.time() - 3600:
                path.unlink()
