"""A specshield server of one's own, for as long as a block lasts."""

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
    """Starts `specshield serve` on a free port, its data in `data`, else in a temporary folder; yields its
    address.

    worker: whether it makes policies too. say: is told how far the server is while it starts. key: one that
    it takes beside those that `data` holds. complete: whether it compiles, once ready, what only some rules
    and robots need, which slows all else for a while. Raises ServerError with the server's log where it does
    not come up.
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
    """Linux: a process that calls this as it begins is told to stop if the one that started it is killed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def _environment(data: Path, worker: bool, key: str | None, complete: bool) -> dict[str, str]:
    """This process's, without what would join the server to another's store or lock it."""
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
    """However long the server takes, unless it ends or says that it cannot become ready."""
    status = 0
    while server.poll() is None and status != 500:
        try:
            answer = httpx.get(f"{url}/readyz", timeout=20.0, verify=False)  # plain HTTP: no certificates
        except httpx.TransportError:
            time.sleep(0.05)
            continue
        if (status := answer.status_code) == 200:
            return
        say(answer.json()["detail"])
        time.sleep(0.1)
    raise ServerError(f"the server did not come up:\n{log.read_text(errors='replace')[-4000:].strip()}")
