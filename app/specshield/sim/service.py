"""Starts a specshield server for the duration of a block."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

from specshield.errors import ServerError


@contextmanager
def own_server(
    worker: bool = False,
    say: Callable[[str], object] = lambda text: None,
    data: Path | None = None,
    key: str | None = None,
    complete: bool = True,
) -> Iterator[str]:
    """Starts `specshield serve` on a free port and yields its address. data: the data folder, by default a
    temporary one.

    worker: whether it makes policies too. say: called with the progress of the server's start. key: a key
    that it takes beside those in `data`. complete: whether it compiles, once ready, the kernels that only
    some sessions need, which slows the rest for a while. Raises ServerError with the server's log if
    it does not become ready.
    """
    with tempfile.TemporaryDirectory(prefix="specshield-") as folder:
        log = Path(folder) / "server.log"
        with socket.create_server(("127.0.0.1", 0)) as probe:  # a port that is free
            url = f"http://127.0.0.1:{probe.getsockname()[1]}"
        with open(log, "wb") as output:
            server = subprocess.Popen(
                [sys.executable, "-m", "specshield.cli", "serve", "--port", url.rpartition(":")[2]],
                env=_environment(data or Path(folder) / "data", worker, key, complete),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                preexec_fn=follow_parent,
            )
        try:
            _wait_until_ready(url, server, log, say)
            yield url
        finally:
            server.terminate()
            try:
                server.wait(15.0)
            except subprocess.TimeoutExpired:
                server.kill()
                server.wait()


def follow_parent() -> None:
    """On Linux, this process gets SIGTERM once the process that started it has ended, even by a kill."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def _environment(data: Path, worker: bool, key: str | None, complete: bool) -> dict[str, str]:
    """The server's environment: this process's, without settings of another store or another key."""
    shipped = ("SPECSHIELD_MAPS_DIR", "SPECSHIELD_MODELS_DIR")
    kept = {
        name: value
        for name, value in os.environ.items()
        if name in shipped or (not name.startswith("SPECSHIELD_") and name != "REDIS_URL")
    }
    own = {"DATA_DIR": data, "WORKER": worker, "COMPLETE": complete, "API_KEY": key}
    return kept | {f"SPECSHIELD_{name}": str(value) for name, value in own.items() if value is not None}


def _wait_until_ready(
    url: str, server: subprocess.Popen[bytes], log: Path, say: Callable[[str], object]
) -> None:
    """Waits until the server is ready. Raises ServerError if it ends or cannot become ready."""
    status = 0
    while server.poll() is None and status != 500:
        try:
            # Plain HTTP on this machine: no certificates, no proxy.
            answer = httpx.get(f"{url}/readyz", timeout=20.0, verify=False, trust_env=False)
        except httpx.TransportError:
            time.sleep(0.05)
            continue
        if (status := answer.status_code) == 200:
            return
        say(answer.json()["detail"])
        time.sleep(0.1)
    raise ServerError(f"the server did not come up:\n{log.read_text(errors='replace')[-4000:].strip()}")
