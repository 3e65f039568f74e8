"""One connection to a single server of the Redis protocol, which all steps of a process share.

redis-py opens it, so that URLs, passwords, TLS and sentinels are its own. What is sent then goes past it:
many callers' commands are on their way at once, and answers come back in order. A call through redis-py costs
350 us of CPU, through this 105 (2,000 appends one after another, a unix socket, a busy machine).
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

TRIES = 3  # after the first, over new connections; all within the caller's time limit. Chosen by hand.
PART = 0.8  # of the time that is left for an answer, in which replicas may have it; the rest is to say so
GONE = ("LOADING", "READONLY", "MASTERDOWN")  # replies of a server that is not, or no longer, the one to ask


class Script:
    """A Lua script, which a server knows by its hash once it has seen it."""

    def __init__(self, text: str) -> None:
        self.text, self.sha = text, hashlib.sha1(text.encode(), usedforsecurity=False).hexdigest()


class Wire:
    """make: what makes redis-py's connection, not yet open. timeout: longest wait for one answer, with all
    tries [s]. replicas: how many of the server's have to have all that an answer tells of before it is given.
    """

    def __init__(self, make: Callable[[], Any], timeout: float, replicas: int = 0) -> None:
        self._make, self._timeout, self._replicas = make, timeout, replicas
        self._link: _Link | None = None
        self._opening = asyncio.Lock()

    async def run(self, script: Script, keys: Sequence[str], args: Sequence[Any]) -> Any:
        """What the script returns. It may run twice where the answer to the first time was lost.

        Raises redis.RedisError, OSError or TimeoutError, and StoreError where replicas are missing.
        """
        deadline = asyncio.get_running_loop().time() + self._timeout
        tries_left = TRIES
        while True:
            link = self._link
            if link is None or link.closed:
                # anyio says again that the time is over: redis-py may miss it once, by asyncio.wait_for.
                with anyio.fail_after(deadline - asyncio.get_running_loop().time()):
                    link = await self._open()  # redis-py tries several times by itself
            try:
                return await _run(link, script, keys, args, deadline)
            except redis.ConnectionError:
                if not tries_left:
                    raise
                tries_left -= 1

    async def _open(self) -> _Link:
        async with self._opening:
            if self._link is None or self._link.closed:
                connection = self._make()
                try:
                    await connection.connect()
                except RuntimeError as error:  # uvloop's word for one that the other side has closed by now
                    raise redis.ConnectionError(str(error)) from error
                self._link = _Link(connection, self._replicas)
            return self._link

    def close(self) -> None:
        if self._link is not None:
            self._link.close()


async def _run(link: _Link, script: Script, keys: Sequence[str], args: Sequence[Any], deadline: float) -> Any:
    try:
        return await link.send(("EVALSHA", script.sha, len(keys), *keys, *args), deadline)
    except redis.ResponseError as error:
        said = str(error)
        if said.startswith(GONE):
            link.close()
            raise redis.ConnectionError(said) from error
        if not said.startswith("NOSCRIPT"):
            raise
    return await link.send(("EVAL", script.text, len(keys), *keys, *args), deadline)


class _Link(asyncio.Protocol):
    """An open connection, taken over from redis-py's; `closed` once it is of no more use.

    Where replicas are asked for, each round of commands ends with a WAIT, and their answers are held until
    the server says how many replicas have what it had done by then.
    """

    def __init__(self, connection: Any, replicas: int = 0) -> None:
        self._connection = connection  # kept, or its transport would be closed
        self._replicas = replicas
        self._transport: asyncio.Transport = connection._writer.transport
        self._transport.set_protocol(self)
        self._reader, self._unsent = hiredis.Reader(), list[bytes]()
        self._waiting = deque[tuple[asyncio.Future[Any] | None, float]]()  # None: a WAIT
        self._held = list[tuple[asyncio.Future[Any], Any]]()
        self._loop = asyncio.get_running_loop()
        self._watch: asyncio.TimerHandle | None = None
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
        """Sends all that callers asked for in one round of the event loop: the store then writes to its disk
        once for all of it.
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
        except RuntimeError as error:  # uvloop's word for one that the other side has closed by now
            self._transport.abort()
            self.connection_lost(error)

    def data_received(self, data: bytes) -> None:
        self._reader.feed(data)
        while (found := self._reader.gets()) is not False:
            if isinstance(found, hiredis.PushNotification):
                continue
            if self.closed:  # its callers are told by connection_lost
                return
            answer, _ = self._waiting.popleft()
            if answer is None:
                self._release(found)
            elif self._replicas:
                self._held.append((answer, found))
            else:
                _give(answer, found)

    def _release(self, count: Any) -> None:
        """Gives the answers that wait for the replicas. count: what WAIT returned."""
        if not isinstance(count, int):  # it is, or has become, a replica itself
            self.close()
            return
        for answer, found in self._held:
            if count < self._replicas and not isinstance(found, hiredis.ReplyError):
                found = too_few(count, self._replicas)
            _give(answer, found)
        self._held.clear()

    def _late(self) -> None:
        """Looks after the oldest that waits. One that is late ends the connection: answers come in order."""
        self._watch = None
        now = self._loop.time()
        while self._waiting and self._waiting[0][1] <= now:
            answer, _ = self._waiting.popleft()
            if answer is not None:
                _give(answer, TimeoutError("the store did not answer in time"))
            self.close()  # also where nobody waits any more: else the next would get this one's answer
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
    """Gives an answer to whoever waits for it, unless they have gone."""
    if answer.done():
        return
    if isinstance(found, hiredis.ReplyError):
        found = redis.ResponseError(str(found))
    if isinstance(found, Exception):
        answer.set_exception(found)
    else:
        answer.set_result(found)
