"""Who is next: the owners take turns, and each of them waits in a line of its own."""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque

from specshield.errors import Busy


class Turns:
    """At most `size` hold a turn at once. The others wait, at most `waiting` of one owner.

    An owner that sends a hundred at once waits for ninety-nine of its own; another owner's next one waits
    for at most one of them.
    """

    def __init__(self, size: int, waiting: int) -> None:
        self._free, self._waiting = size, waiting
        self._lines: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()

    async def take(self, owner: str) -> None:
        """Returns when it is this caller's turn. Raises Busy where too many of the owner's wait."""
        if self._free > 0:
            self._free -= 1
            return
        line = self._lines.setdefault(owner, deque())
        if len(line) >= self._waiting:
            raise Busy(
                f"{len(line)} requests of this kind wait already", expected="the request again, in a while"
            )
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        line.append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():  # the turn had come already
                self.give()
            elif turn in line:
                line.remove(turn)
                self._drop_if_empty(owner)
            raise

    def give(self) -> None:
        """Hands a turn back: to the owner that had one longest ago."""
        while self._lines:
            owner, line = next(iter(self._lines.items()))
            turn = line.popleft()
            self._lines.move_to_end(owner)
            self._drop_if_empty(owner)
            if not turn.done():  # else it was cancelled just now
                turn.set_result(None)
                return
        self._free += 1

    def _drop_if_empty(self, owner: str) -> None:
        if not self._lines.get(owner, True):
            del self._lines[owner]
