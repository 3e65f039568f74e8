"""As much of a calculation as can be had in some seconds, however long each of its steps takes."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing import get_context
from typing import TypeVar

from specshield.service.storage.keeper import follow_parent

V = TypeVar("V")
FORK = get_context("fork")


def latest(values: Iterator[V], seconds: float) -> V | None:
    """The last of the values that come within so many seconds, None where none does.

    They are made in a fork of this process, which the system ends then: a kernel that runs hears nothing. It
    also ends when this process does. Raises MemoryError where it ends in another way.
    """
    reading, writing = FORK.Pipe(duplex=False)

    def send() -> None:
        follow_parent()
        reading.close()
        signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))  # 0 would be none
        for value in values:
            writing.send(value)

    process, found = FORK.Process(target=send), None
    process.start()
    writing.close()
    with suppress(EOFError, OSError):  # its end, perhaps amid a value
        while True:
            found = reading.recv()
    process.join()
    if process.exitcode not in (0, -signal.SIGALRM):
        raise MemoryError(f"the fork ended with {process.exitcode}")  # most likely for want of it
    return found
