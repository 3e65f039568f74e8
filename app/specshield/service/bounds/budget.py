"""Bytes that requests may hold at once, all of them together."""

from __future__ import annotations

from specshield.errors import Busy


class Budget:
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
