"""How a server leaves: /readyz says so first, so that balancers send nothing new, and then it stops."""

from __future__ import annotations

import asyncio
import signal
import threading
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the parent of several servers decides nothing
    from specshield.service.startup import Startup

GRACE = 10  # [s] that running requests and streams have once the server takes no more; chosen by hand


def drain_at_sigterm(startup: Startup, seconds: float) -> None:
    """From SIGTERM on /readyz answers 503 and everything else goes on; `seconds` later the server stops.

    A second SIGTERM, or SIGINT, stops it at once. To be called in the server's event loop.
    """
    if threading.current_thread() is not threading.main_thread():
        return  # a server inside another program, which has its own signals
    loop, stop = asyncio.get_running_loop(), signal.getsignal(signal.SIGTERM)

    def told(signum: int, frame: Any) -> None:
        again, startup.stopping = startup.stopping, True
        if callable(stop):
            if again or seconds <= 0:
                stop(signum, frame)
            else:
                loop.call_soon_threadsafe(loop.call_later, seconds, stop, signum, frame)

    signal.signal(signal.SIGTERM, told)  # uvicorn puts its caller's handler back at the end
