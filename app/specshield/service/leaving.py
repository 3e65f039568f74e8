"""How a server stops: first /readyz says so, so that balancers send no new requests, and later the server
stops and closes its streams. Also, how uvicorn's supervisor notices that a worker was killed.
"""

from __future__ import annotations

import asyncio
import math
import signal
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from prometheus_client.multiprocess import mark_process_dead
from uvicorn.supervisors.multiprocess import Process

if TYPE_CHECKING:  # the parent of several servers does not need it
    from specshield.service.startup import Startup

ECHO = 1.0  # [s] if a whole group is told to stop, as by systemd, the supervisor tells its workers once more
GRACE = 10  # [s] for running requests and streams once the server takes no new ones; chosen by hand


class Streams:
    """The open streams of this process: functions that end them after the message that is being answered."""

    def __init__(self) -> None:
        self.open, self.closed = set[Callable[[], None]](), False

    def close(self) -> None:
        self.closed = True
        for stop in list(self.open):
            stop()

    def close_at_stop(self) -> None:
        """Closes the streams when the server is told to stop. To be called in the server's event loop."""
        loop = asyncio.get_running_loop()

        def told(stop: Callable[[], object]) -> None:
            loop.call_soon_threadsafe(self.close)
            stop()

        _tell(told, signal.SIGTERM, signal.SIGINT)


def drain_at_sigterm(startup: Startup, seconds: float) -> None:
    """After SIGTERM, /readyz answers 503 and everything else goes on; `seconds` later the server stops.

    SIGINT, or a SIGTERM more than ECHO later, stops it at once. To be called in the server's event loop.
    """
    loop, first = asyncio.get_running_loop(), math.inf

    def told(stop: Callable[[], object]) -> None:
        nonlocal first
        again, startup.stopping = startup.stopping, True
        if seconds <= 0 or time.monotonic() - first > ECHO:
            stop()
        elif not again:
            first = time.monotonic()
            loop.call_soon_threadsafe(loop.call_later, seconds, stop)

    _tell(told, signal.SIGTERM)


def notice_killed() -> None:
    """From now on uvicorn's supervisor closes its own copy of a worker's end of the pipe between them, and
    the metrics forget the streams of a worker that has ended.

    The supervisor asks each worker for a sign of life through that pipe. While the copy is open, it does not
    notice that a worker is killed meanwhile, and waits for as long as a worker may take to start.
    """
    start, join = Process.start, Process.join

    def start_and_close(worker: Process) -> None:
        start(worker)
        worker.child_conn.close()

    def join_and_forget(worker: Process) -> None:
        join(worker)
        mark_process_dead(worker.pid)  # type: ignore[no-untyped-call]

    Process.start = start_and_close  # type: ignore[assignment, method-assign]
    Process.join = join_and_forget  # type: ignore[assignment, method-assign]


def _tell(told: Callable[[Callable[[], object]], None], *numbers: signal.Signals) -> None:
    """Has `told` called for these signals, with the former handler; uvicorn restores its caller's handlers at
    the end. Does nothing outside the main thread: there the server is part of another program.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    for number in numbers:
        signal.signal(number, partial(_handle, told, signal.getsignal(number)))


def _handle(told: Callable[[Callable[[], object]], None], before: Any, number: int, frame: Any) -> None:
    told(partial(before, number, frame) if callable(before) else lambda: None)
