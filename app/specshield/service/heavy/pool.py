"""A pool of child processes for calls that take long. One a server process.

Nothing runs until the first call. Each call has a child to itself, a time limit, and the child a memory
limit. A child is killed when its call takes too long or is cancelled, and one that keeps much memory after
a call is let go, so that what an expensive request took comes back. Children that have nothing to do end.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from specshield.errors import ServerError, TooExpensive
from specshield.service.heavy.child import LENGTH, LIMITS
from specshield.service.heavy.queue import Turns

# Chosen by hand; `python -m benchmarks.attacks` shows what they come to.
STARTS_WITHIN = 60  # [s] that a process may take to import everything on a busy machine
MAY_GROW = 64 << 20  # [bytes] a child holds more than at its start when it is let go after a call


class Template:
    """The process that children are forked from. It is started with the first of them."""

    def __init__(self) -> None:
        self._control: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def fork(self, memory: int, nice: int) -> socket.socket:
        """The socket of a new child, which says its process id there first."""
        if self._process is None or self._process.poll() is not None:
            self.stop()
            self._control, theirs = socket.socketpair()
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "specshield.service.heavy.child"],
                    stdin=theirs.fileno(),
                    env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
                    start_new_session=True,
                )
        assert self._control is not None
        ours, theirs = socket.socketpair()
        with theirs:
            socket.send_fds(self._control, [LIMITS.pack(memory, nice)], [theirs.fileno()])
        ours.setblocking(False)
        return ours

    def stop(self) -> None:
        if self._control is not None:
            self._control.close()
            self._control = None
        if self._process is not None:
            self._process.kill()
            self._process.wait()  # it has only just been killed
            self._process = None


@dataclass(eq=False)
class _Child:
    """floor: the memory at its start [bytes]. key: of its last call. since: that call ended then [s]."""

    pid: int
    floor: int
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    key: Hashable = None
    since: float = 0.0

    async def call(self, function: str, arguments: tuple[Any, ...]) -> Any:
        content = pickle.dumps((function, arguments), protocol=5)
        self.writer.write(LENGTH.pack(len(content)))
        self.writer.write(content)
        await self.writer.drain()
        return await _read(self.reader)

    def kill(self) -> None:
        """At once, unless it writes what it has claimed: then it ends when it finds its caller gone."""
        if not self.reader.at_eof():  # it is there still, and the process id is its own
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)
        self.writer.close()


@dataclass(eq=False)
class Pool:
    """size: children at once. memory [bytes]: the most that a child may take. waiting: calls of one owner
    that may wait. idle [s]: a child without a call ends after as long. unused: called when the last child
    has ended, with the time of the end of its last call. children: how many there are.
    """

    template: Template
    size: int
    memory: int
    nice: int
    waiting: int
    idle: float
    unused: Callable[[float], None]
    children: int = 0

    def __post_init__(self) -> None:
        self._turns, self._idle = Turns(self.size, self.waiting), list[_Child]()
        self._sweeping: asyncio.TimerHandle | None = None

    async def run(
        self, function: str, *arguments: Any, seconds: float, owner: str = "", key: Hashable = None
    ) -> Any:
        """What "module:function" returns in a child; a SpecshieldError that it raises is raised here.

        seconds: of its running, not of its waiting. key: calls of one key go to one child where that is free,
        for what the child has kept. Raises Busy where the owner has too many waiting, TooExpensive where it
        takes more time or memory than it may. Cancelling this kills the child.
        """
        await self._turns.take(owner)
        try:
            return await self._run(function, arguments, seconds, key)
        finally:
            self._turns.give()

    async def _run(self, function: str, arguments: tuple[Any, ...], seconds: float, key: Hashable) -> Any:
        child = await self._child(key)
        keep = False
        try:
            async with asyncio.timeout(seconds):
                value, error, resident = await child.call(function, arguments)
            keep = resident < child.floor + MAY_GROW
        except TimeoutError:
            raise _too_expensive(f"it took more than {seconds:g} s") from None
        except (asyncio.IncompleteReadError, ConnectionError):
            raise _too_expensive("the process that worked on it ended") from None
        finally:
            child.key, child.since = key, time.monotonic()
            if not keep:
                self._let_go(child)
            else:
                self._idle.append(child)
                if self._sweeping is None:
                    self._sweeping = asyncio.get_running_loop().call_later(self.idle, self._sweep)
        if isinstance(error, MemoryError):
            raise _too_expensive(f"it took more than {self.memory >> 20} MiB")
        if error is not None:
            raise error if not isinstance(error, RuntimeError) else ServerError(str(error))
        return value

    async def _child(self, key: Hashable) -> _Child:
        """One that has nothing to do: the last to have worked for this key, else a new one, else any."""
        for dead in [child for child in self._idle if child.reader.at_eof()]:  # for want of memory, say
            self._idle.remove(dead)
            self._let_go(dead)
        found = next((child for child in reversed(self._idle) if child.key == key), None)
        if found is None and self.children >= self.size:
            found = self._idle[0]  # the longest idle; there is one, since this is the caller's turn
        if found is not None:
            self._idle.remove(found)
            return found
        self.children += 1
        try:
            return await self._start()
        except BaseException:
            self.children -= 1
            raise

    async def _start(self, again: bool = True) -> _Child:
        try:
            return await self._fork()
        except (OSError, asyncio.IncompleteReadError) as error:
            self.template.stop()
            if again:  # an old template may have died since the last child
                return await self._start(again=False)
            raise ServerError("a process for this does not start; the server's log says more") from error

    async def _fork(self) -> _Child:
        ours = self.template.fork(self.memory, self.nice)
        reader, writer = await asyncio.open_connection(sock=ours)
        try:
            async with asyncio.timeout(STARTS_WITHIN):
                pid, floor = await _read(reader)
                return _Child(pid, floor, reader, writer)
        except BaseException:
            writer.close()
            raise

    def _let_go(self, child: _Child) -> None:
        child.kill()
        self.children -= 1
        if self.children == 0:
            self.unused(child.since)

    def _sweep(self) -> None:
        """Ends the children that have been idle for long, and looks again when the next will have been."""
        self._sweeping = None
        now = time.monotonic()
        while self._idle and self._idle[0].since + self.idle <= now + 0.01:
            self._let_go(self._idle.pop(0))
        if self._idle:
            later = self._idle[0].since + self.idle - now
            self._sweeping = asyncio.get_running_loop().call_later(later, self._sweep)

    def close(self) -> None:
        if self._sweeping is not None:
            self._sweeping.cancel()
        while self._idle:
            self._let_go(self._idle.pop())


async def _read(reader: asyncio.StreamReader) -> Any:
    (length,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
    return pickle.loads(await reader.readexactly(length))  # from this server's own child


def _too_expensive(reason: str) -> TooExpensive:
    return TooExpensive(
        f"the request is too expensive: {reason}", expected="one that takes less time and memory"
    )
