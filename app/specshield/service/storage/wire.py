"""One connection to a single server of the Redis protocol, which all steps of a process share.

redis-py opens the connection, so that it handles URLs, passwords, TLS and sentinels. This module then uses it
directly: the commands of many callers are under way together, and their answers come in order. A call takes
105 us of CPU, and 350 by redis-py (2,000 appends one after another, a unix socket, a busy machine).
"""

from __future__ import annotations

import asyncio
import hashlib
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import anyio
import hiredis
import redis

from specshield.errors import StoreError

TRIES = 3  # after the first one, over new connections, all within the caller's time limit. Chosen by hand.
PART = 0.8  # share of the remaining time in which replicas have to follow; the rest is for the answer
GONE = ("LOADING", "READONLY", "MASTERDOWN")  # replies of a server that cannot be used, or not any more


class Script:
    """A Lua script, which a server knows by its hash once it has seen it."""

    def __init__(self, text: str) -> None:
        self.text, self.sha = text, hashlib.sha1(text.encode(), usedforsecurity=False).hexdigest()


class Wire:
    """make: makes a connection of redis-py, not yet open. timeout: longest wait for one answer, all tries
    included [s]. replicas: how many replicas need to have all that an answer tells before it is given.
    """

    def __init__(self, make: Callable[[], Any], timeout: float, replicas: int = 0) -> None:
        self._make, self._timeout, self._replicas = make, timeout, replicas
        self._link: _Link | None = None
        self._opening = asyncio.Lock()

    async def run(self, script: Script, keys: Sequence[str], args: Sequence[Any]) -> Any:
        """What the script returns. The script may run twice if its first answer was lost.

        Raises redis.RedisError, OSError or TimeoutError, and StoreError if too few replicas followed.
        """
        deadline = asyncio.get_running_loop().time() + self._timeout
        tries_left = TRIES
        while True:
            link = self._link
            if link is None or link.closed:
                # anyio cancels repeatedly: asyncio.wait_for in redis-py may swallow the first cancellation.
                with anyio.fail_after(deadline - asyncio.get_running_loop().time()):
                    link = await self._open()  # redis-py itself tries several times
            try:
                return await _run(link, script, keys, args, deadline)
            except redis.ConnectionError:
                if not tries_left:
                    raise
                tries_left -= 1

    async def of_each(self, name: str) -> list[str]:
        """A key for each server that has keys of its own; here there is one."""
        return [name]

    async def _open(self) -> _Link:
        async with self._opening:
            if self._link is None or self._link.closed:
                connection = self._make()
                try:
                    await connection.connect()
                except RuntimeError as error:  # uvloop's error if the other side has closed it by now
                    raise redis.ConnectionError(str(error)) from error
                self._link = _Link(connection, self._replicas)
            return self._link

    def close(self) -> None:
        if self._link is not None:
            self._link.close()


async def _run(link: _Link, script: Script, keys: Sequence[str], args: Sequence[Any], deadline: float) -> Any:
    """The first call of a script on a connection carries its text. The server might not know its hash, and if
    too few replicas follow, the WAIT after that refusal uses up the time in which the text could be sent.
    """
    called = ("EVALSHA", script.sha) if script in link.sent else ("EVAL", script.text)
    link.sent.add(script)
    try:
        return await link.send((*called, len(keys), *keys, *args), deadline)
    except redis.ResponseError as error:
        said = str(error)
        if said.startswith(GONE):
            link.close()
            raise redis.ConnectionError(said) from error
        if not said.startswith("NOSCRIPT"):
            raise
    link.sent.discard(script)  # the store has lost it, as after SCRIPT FLUSH
    return await _run(link, script, keys, args, deadline)


class _Link(asyncio.Protocol):
    """An open connection, taken over from redis-py; `closed` once it cannot be used any more. sent: scripts
    whose text the server has been sent.

    With `replicas`, each round of commands ends with a WAIT. Their answers are held until the server says how
    many replicas have followed; errors are not.
    """

    def __init__(self, connection: Any, replicas: int = 0) -> None:
        self._connection = connection  # is referenced here, since its deletion would close the transport
        self._replicas = replicas
        self._transport: asyncio.Transport = connection._writer.transport
        self._transport.set_protocol(self)
        self._reader, self._unsent = hiredis.Reader(), list[bytes]()
        self._waiting = deque[tuple[asyncio.Future[Any] | None, float]]()  # None: a WAIT
        self._held = list[tuple[asyncio.Future[Any], Any]]()
        self._loop = asyncio.get_running_loop()
        self._watch: asyncio.TimerHandle | None = None
        self.sent = set[Script]()
        self.closed = self._transport.is_closing()

    async def send(self, command: tuple[Any, ...], deadline: float) -> Any:
        if self.closed:
            raise redis.ConnectionError("the connection is closed")
        if not self._unsent:
            self._loop.call_soon(self._flush)
        self._unsent.append(hiredis.pack_command(command))
        answer: asyncio.Future[Any] = self._loop.create_future()
        self._waiting.append((answer, deadline))
        if self._watch is None:
            self._watch = self._loop.call_at(deadline, self._late)
        return await answer

    def _flush(self) -> None:
        """Sends the commands of one round of the event loop together: the store then writes to its disk once
        for all of them.
        """
        content = b"".join(self._unsent)
        self._unsent.clear()
        if self._replicas and self._waiting:
            deadline = self._waiting[-1][1]
            longest = max(int(PART * 1000 * (deadline - self._loop.time())), 1)
            wait: tuple[Any, ...] = ("WAIT", self._replicas, longest)
            content += hiredis.pack_command(wait)
            self._waiting.append((None, deadline))
        try:
            self._transport.write(content)
        except RuntimeError as error:  # uvloop's error if the other side has closed it by now
            self._transport.abort()
            self.connection_lost(error)

    def data_received(self, data: bytes) -> None:
        self._reader.feed(data)
        while (found := self._reader.gets()) is not False:
            if isinstance(found, hiredis.PushNotification):
                continue
            if self.closed:  # `connection_lost` tells the callers
                return
            answer, _ = self._waiting.popleft()
            if answer is None:
                self._release(found)
            elif self._replicas and not isinstance(found, hiredis.ReplyError):
                self._held.append((answer, found))
            else:
                _give(answer, found)

    def _release(self, count: Any) -> None:
        """Gives the answers that were held for the replicas. count: what WAIT returned."""
        if not isinstance(count, int):  # the server is, or has become, a replica itself
            self.close()
            return
        for answer, found in self._held:
            if count < self._replicas:
                found = too_few(count, self._replicas)
            _give(answer, found)
        self._held.clear()

    def _late(self) -> None:
        """Ends the connection if the oldest answer is late: the later ones come after it."""
        self._watch = None
        now = self._loop.time()
        while self._waiting and self._waiting[0][1] <= now:
            answer, _ = self._waiting.popleft()
            if answer is not None:
                _give(answer, TimeoutError("the store did not answer in time"))
            self.close()  # even if nobody waits any more: else the next caller would get this answer
        if self._waiting:
            self._watch = self._loop.call_at(self._waiting[0][1], self._late)

    def connection_lost(self, error: Exception | None) -> None:
        self.closed = True
        if self._watch is not None:
            self._watch.cancel()
        for answer, _ in (*self._held, *self._waiting):
            if answer is not None:
                _give(answer, redis.ConnectionError(f"the connection was lost: {error}"))
        self._held.clear()
        self._waiting.clear()

    def close(self) -> None:
        self.closed = True
        self._transport.abort()


def too_few(count: Any, replicas: int) -> StoreError:
    said = f"{count} of {replicas} replicas of the store had the answer in time"
    return StoreError(said, expected="what SPECSHIELD_STORE_REPLICAS asks for")


def _give(answer: asyncio.Future[Any], found: Any) -> None:
    """Gives an answer to its caller, unless the caller has been cancelled."""
    if answer.done():
        return
    if isinstance(found, hiredis.ReplyError):
        found = redis.ResponseError(str(found))
    if isinstance(found, Exception):
        answer.set_exception(found)
    else:
        answer.set_result(found)
