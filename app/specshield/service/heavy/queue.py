"""Shares a number of turns among owners, each of which has its own waiting line."""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque

from specshield.errors import Busy


class Turns:
    """At most `size` callers have a turn at once. The others wait, at most `waiting` of one owner.

    Owners take turns: if one sends a hundred calls at once, another owner's next call waits for one of them.
    """

    def __init__(self, size: int, waiting: int) -> None:
        self._free, self._waiting = size, waiting
        self._lines: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()

    async def take(self, owner: str) -> None:
        """Returns when it is this caller's turn. Raises Busy if too many calls of the owner wait."""
        if self._free > 0:
            self._free -= 1
            return
        line = self._lines.setdefault(owner, deque())
        if len(line) >= self._waiting:
            raise Busy(
                f"{len(line)} requests of this kind wait already", expected="the request again in a while"
            )
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        line.append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():  # the turn had been given already
                self.give()
            elif turn in line:
                line.remove(turn)
                self._drop_if_empty(owner)
            raise

    def give(self) -> None:
        """Hands a turn on to the waiting owner that had one longest ago."""
        while self._lines:
            owner, line = next(iter(self._lines.items()))
            turn = line.popleft()
            self._lines.move_to_end(owner)
            self._drop_if_empty(owner)
            if not turn.done():  # else its caller was cancelled just now
                turn.set_result(None)
                return
        self._free += 1

    def _drop_if_empty(self, owner: str) -> None:
        if not self._lines.get(owner, True):
            del self._lines[owner]
