"""How a server stops: first /readyz says so, so that balancers send no new requests, and later the server
stops and closes its streams. Also, how uvicorn's supervisor notices that a worker was killed, and how what a
killed supervisor has left is removed.
"""

from __future__ import annotations

import asyncio
import fcntl
import math
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prometheus_client.multiprocess import mark_process_dead
from uvicorn.supervisors.multiprocess import Process

if TYPE_CHECKING:  # the parent of several servers does not need it
    from specshield.service.startup import Startup

COUNTS = "specshield-counts-"  # how the folders of counts begin, below the temporary directory
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


def heed_signals(startup: Startup, streams: Streams, drain: float) -> None:
    """After SIGTERM, /readyz answers 503 and everything else goes on; `drain` seconds later the streams are
    closed and the server stops. SIGINT, or a SIGTERM more than ECHO later, stops it at once. SIGHUP, as of a
    terminal that is closed, counts as SIGTERM, unless it is ignored (nohup).

    To be called in the server's event loop, where uvicorn's handlers are set. Does nothing outside the main
    thread: there the server is part of another program.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    loop, first = asyncio.get_running_loop(), math.inf
    uvicorns = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

    def stop(number: int, frame: Any) -> None:
        loop.call_soon_threadsafe(streams.close)
        if callable(before := uvicorns[signal.Signals(number)]):
            before(number, frame)

    def told(number: int, frame: Any) -> None:
        nonlocal first
        again, startup.stopping = startup.stopping, True
        if drain <= 0 or number == signal.SIGINT or time.monotonic() - first > ECHO:
            stop(number, frame)
        elif not again:
            first = time.monotonic()
            loop.call_soon_threadsafe(loop.call_later, drain, stop, number, frame)

    for number in uvicorns:
        signal.signal(number, told)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        signal.signal(signal.SIGHUP, lambda _, frame: told(signal.SIGTERM, frame))


@contextmanager
def folder_of_counts() -> Iterator[str]:
    """A folder for the counts of several server processes, which is removed at the end of the block. Those
    that killed supervisors have left are removed too: a supervisor holds a lock on its own.
    """
    for left in Path(tempfile.gettempdir()).glob(f"{COUNTS}*"):
        with suppress(OSError), _locked(left, fcntl.LOCK_NB):  # not one in use, or of another user
            shutil.rmtree(left)
    with ExitStack() as held:
        folder = ""
        while not os.path.isdir(folder):  # another start may have taken it before it was locked
            folder = tempfile.mkdtemp(prefix=COUNTS)
            with suppress(FileNotFoundError):
                held.enter_context(_locked(folder))
        held.callback(shutil.rmtree, folder, ignore_errors=True)
        yield folder


@contextmanager
def _locked(folder: str | Path, more: int = 0) -> Iterator[None]:
    opened = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | more)
        yield
    finally:
        os.close(opened)


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
