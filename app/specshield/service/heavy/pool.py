"""A pool of child processes for calls that take long.

No process runs until the first call. Each call has a child of its own and a time limit, and the child has a
memory limit. A child is killed when its call takes too long or is cancelled. A child that keeps much memory
after a call ends, so that the memory of an expensive request is freed. Idle children end after a while.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import time
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable, Hashable
from dataclasses import dataclass
from typing import Any, TypeVar

from specshield.errors import Busy, ServerError, TooExpensive
from specshield.service.heavy.child import LENGTH, LIMITS, NOT_BEGUN

# Chosen by hand; `python -m benchmarks.attacks` shows their effect.
STARTS_WITHIN = 60  # [s] that a process may take to import everything on a busy machine
MAY_GROW = 64 << 20  # [bytes] of additional memory after a call with which a child is not kept
ENDED = asyncio.IncompleteReadError, ConnectionError  # raised for a process that has ended
T = TypeVar("T")
log = logging.getLogger("specshield")


class Template:
    """The process from which children are forked. It is started with the first child."""

    def __init__(self) -> None:
        self._control: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def fork(self, memory: int, nice: int) -> socket.socket:
        """The socket of a new child, which first sends its process id and its memory there."""
        if not self.runs():
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

    def runs(self) -> bool:
        """Whether its process runs. A process that ends closes its sockets before its status is known."""
        if self._control is None or self._process is None or self._process.poll() is not None:
            return False
        look = select.poll()
        look.register(self._control, 0)
        return not look.poll(0)

    def stop(self) -> None:
        if self._control is not None:
            self._control.close()
            self._control = None
        if self._process is not None:
            self._process.kill()
            self._process.wait()  # takes no time after the kill
            self._process = None


@dataclass(eq=False)
class _Child:
    """floor: the memory at its start [bytes]. key: of its last call. since: when that call ended [s]."""

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
        """Ends the child at once, or if it is writing what it has claimed, after that."""
        if not self.reader.at_eof():  # the child still runs, so that the process id is its own
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)
                os.kill(self.pid, signal.SIGCONT)  # if it was stopped, it ends only now
        self.writer.close()


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

    async def having(self, owner: str, call: Callable[..., Awaitable[T]], /, *args: Any, **kwargs: Any) -> T:
        """The result of a call that is made when it is this caller's turn."""
        await self.take(owner)
        try:
            return await call(*args, **kwargs)
        finally:
            self.give()

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


@dataclass(eq=False)
class Pool:
    """size: the most children at once. memory: the most for one child [bytes]. waiting: the most waiting
    calls of one owner. idle: how long a child without a call stays [s]. unused: called after the end of the
    last child, with the time at which its last call ended. children: the number of children now.
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
        """The result of "module:function" in a child. A SpecshieldError of the function is raised here.

        seconds: the time limit, without the time of waiting. key: calls with the same key go to the same
        child if it is free, for what it has kept. A call whose child ends is made once more. Raises Busy if
        the owner has too many waiting calls, TooExpensive for a call that takes too much time or memory.
        Cancelling this call kills the child.
        """
        await self._turns.take(owner)
        try:
            with contextlib.suppress(*ENDED):  # it may have been killed for the memory that others take
                return await self._run(function, arguments, seconds, key)
            return await self._run(function, arguments, seconds, key)
        except ENDED:
            if not self.template.runs():  # with it all children end, and none of their calls is to blame
                raise _none_to_do_it() from None
            raise _too_expensive("the process that worked on it ended") from None
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
        """An idle child: the last one that worked for this key, else a new one, else any."""
        for dead in [child for child in self._idle if child.reader.at_eof()]:  # as when memory ran out
            self._idle.remove(dead)
            self._let_go(dead)
        found = next((child for child in reversed(self._idle) if child.key == key), None)
        if found is None and self.children >= self.size:
            found = self._idle[0]  # the longest idle; there is one, since the caller has a turn
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
        except TimeoutError:  # an OSError too, so it comes first
            self.template.stop()  # it hangs, and nobody would get a child
        except ENDED:
            pass  # the template may have died since the last child; it is begun anew where it has
        except OSError as error:
            log.warning("a process for heavy work cannot be begun: %s", error)
            raise _none_to_do_it() from error
        if again:
            return await self._start(again=False)
        raise ServerError("a process for this does not start; the server's log says more")

    async def _fork(self) -> _Child:
        ours = self.template.fork(self.memory, self.nice)
        reader, writer = await asyncio.open_connection(sock=ours)
        try:
            async with asyncio.timeout(STARTS_WITHIN):
                pid, floor = begun = await _read(reader)
        except BaseException:
            writer.close()
            raise
        if begun == NOT_BEGUN:
            writer.close()
            raise _none_to_do_it()
        return _Child(pid, floor, reader, writer)

    def _let_go(self, child: _Child) -> None:
        child.kill()
        self.children -= 1
        if self.children == 0:
            self.unused(child.since)

    def _sweep(self) -> None:
        """Ends the children that have been idle for too long, and sets a timer for the next one."""
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


def _none_to_do_it() -> Busy:
    return Busy("the server has no process for this just now", expected="the request again in a while")
