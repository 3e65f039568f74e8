"""The streams that a process has open, and their end when it is told to stop."""

from __future__ import annotations

import asyncio
import signal
import threading
from typing import Any, Protocol


class Stream(Protocol):
    def stop(self) -> None:
        """Says goodbye, after the message that is being answered."""


class Streams:
    """The streams of this process that are open."""

    def __init__(self) -> None:
        self.open = set[Stream]()

    def close(self) -> None:
        for stream in list(self.open):
            stream.stop()

    def close_at_stop(self) -> None:
        """Closes them as soon as the server is told to stop. To be called in the server's event loop."""
        if threading.current_thread() is not threading.main_thread():
            return  # a server inside another program, which has its own signals
        loop = asyncio.get_running_loop()
        for name in (signal.SIGTERM, signal.SIGINT):
            stop = signal.getsignal(name)

            def told(signum: int, frame: Any, stop: Any = stop) -> None:
                loop.call_soon_threadsafe(self.close)
                if callable(stop):
                    stop(signum, frame)

            signal.signal(name, told)  # uvicorn puts its caller's handlers back at the end
