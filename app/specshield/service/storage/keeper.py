"""Keeps the embedded store running as long as any process uses it.

Run as `python keeper.py <folder> <server binary> <arguments...>` with the read end of the users' pipe as
standard input. Every user holds a write end. Once the last user has ended, even if it was killed, the pipe
reaches its end, and the store is told to stop. This imports the standard library alone, to start in 15 ms.
"""

import ctypes
import fcntl
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

LOCK = "keeper.lock"
GRACE = 10.0  # [s] for the store to write its file and end


def private(path: str, flags: int) -> int:
    """An opener for `open`: a new file can be read and written by this user alone."""
    return os.open(path, flags, 0o600)


def follow_parent() -> None:
    """On Linux, this process gets SIGTERM once the process that started it has ended, even by a kill."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def at_end_of_input(action: Callable[[], object]) -> None:
    """Calls `action` in a thread once standard input ends: a pipe from the process that started this one."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        action()

    threading.Thread(target=wait, daemon=True).start()


def _as_store() -> None:
    """Lets SIGTERM end the store, which would else ignore it as the keeper does."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    follow_parent()


def main(folder: Path, command: list[str]) -> int:
    """Holds the lock, runs the store, and stops it at the end of standard input. Exits with its status."""
    lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o600)
    fcntl.flock(lock, fcntl.LOCK_EX)  # waits until the previous store has ended
    with open(folder / "store.log", "ab", buffering=0) as log:
        # The store inherits the lock's descriptor, so that the lock is free only once both have ended.
        store = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            cwd=folder,
            pass_fds=[lock],
            preexec_fn=_as_store,
        )

    def stop() -> None:
        store.terminate()
        threading.Timer(GRACE, store.kill).start()

    at_end_of_input(stop)
    status = store.wait()
    os._exit(status if status >= 0 else 128 - status)  # do not wait for the timer


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the end of the pipe ends the keeper
    main(Path(sys.argv[1]), sys.argv[2:])
