"""Keeps the embedded store running while anybody uses it, and not a moment longer.

Run as `python keeper.py <folder> <server binary> <arguments...>` with the read end of the users' pipe as
standard input. Every user holds a write end; the pipe reaches its end when the last of them is gone, however
it went, and the store is then told to stop. Only the standard library is imported: this starts in 15 ms.
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
GRACE = 10.0  # seconds for the store to write its file out and leave


def private(path: str, flags: int) -> int:
    """For `open`: a file that is made is this user's alone."""
    return os.open(path, flags, 0o600)


def follow_parent() -> None:
    """Linux: this process is told to stop when the one that started it is gone, however it went."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def at_end_of_input(action: Callable[[], object]) -> None:
    """Calls it, in a thread, when standard input ends: a pipe from whoever started this process."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        action()

    threading.Thread(target=wait, daemon=True).start()


def _as_store() -> None:
    """It can be told to stop from its first moment on; the keeper, whose signals it takes over, cannot."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    follow_parent()


def main(folder: Path, command: list[str]) -> int:
    """Hold the lock, run the store, stop it at the end of standard input; its exit status."""
    lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o600)
    fcntl.flock(lock, fcntl.LOCK_EX)  # waits until the store before this one has let go of the file
    with open(folder / "store.log", "ab", buffering=0) as log:
        # The lock's descriptor goes to the store too: it is free only when both are gone.
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
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the pipe says when; the store gets its own signals
    main(Path(sys.argv[1]), sys.argv[2:])
