"""One request's body as it comes in: in memory while it is small, in a file beyond that. What all of them
together may hold is bounded.
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

FREE = 64 << 10  # [bytes] of each body that no budget counts: a step fits, whatever others send
IN_MEMORY = 1 << 20  # [bytes] of a body that are held in memory before they go to its file


class Budget:
    """Bytes that requests may hold at once, all of them together."""

    def __init__(self, limit: int) -> None:
        self._left = limit

    def take(self, size: int) -> None:
        """Raises Busy where there is no room for so many bytes."""
        if size > self._left:
            raise Busy(
                "the server holds as many bytes of requests as it may",
                expected="the request again, in a while",
            )
        self._left -= size

    def give(self, size: int) -> None:
        self._left += size


@dataclass
class Body:
    """folder: where the file of a large body goes. `close` gives everything back."""

    budget: Budget
    folder: Path
    content_type: str
    size: int = 0
    _held: bytearray = field(default_factory=bytearray)
    _file: Any = None

    async def add(self, chunk: bytes) -> None:
        """Raises Busy where the requests together hold too much."""
        counted = max(self.size - FREE, 0)
        self.budget.take(max(self.size + len(chunk) - FREE, 0) - counted)
        self.size += len(chunk)
        self._held += chunk
        if len(self._held) > IN_MEMORY:
            await self._write()

    async def end(self) -> None:
        """No more will come."""
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
    """The body of an upload, which bodies.py has taken in."""
    body: Body = request.scope["state"]["body"]
    return body


def clear(folder: Path) -> None:
    """Removes what servers that were killed have left: no body takes an hour."""
    for path in folder.glob("*"):
        with contextlib.suppress(OSError):
            if path.stat().st_mtime < time.time() - 3600:
                path.unlink()
