"""A connection that sends what is written in one go together: the head of an answer and its body.

uvloop writes at once, so uvicorn's two writes an answer are two system calls, of which each costs as much as
parsing a request (measured with py-spy under `python -m benchmarks.step_cost`).
"""

from __future__ import annotations

import asyncio
from typing import Any

AT_ONCE = 1 << 16  # [bytes] what is larger gains nothing by waiting


class Corked:
    """A transport. What is written leaves when the event loop comes round, before it reads anything more."""

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._transport, self._loop = transport, loop
        self._held: list[bytes] = []

    def write(self, data: bytes) -> None:
        if not self._held:
            self._loop.call_soon(self._flush)
        self._held.append(data)
        if len(data) > AT_ONCE:
            self._flush()

    def close(self) -> None:
        self._flush()
        self._transport.close()

    def _flush(self) -> None:
        if self._held:
            content = b"".join(self._held) if len(self._held) > 1 else self._held[0]
            self._held.clear()
            self._transport.write(content)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)
