"""A real server for tests: its own process, port, data folder and embedded store."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO

import httpx
import psutil

# The commands of `evaluation`, whose modules the template imports for the first of them.
EVALUATION = {"evaluate", "worlds", "results", "rewards", "curves", "habits", "rivals", "report"}
_ONE = threading.Lock()  # held while the template is begun


class Forked:
    """`specshield` with these arguments, forked from the template. It has of a Popen what tests use."""

    def __init__(self, arguments: list[str], environment: dict[str, str], **files: Path) -> None:
        """files: `stdout` and `stderr`, and the folder `cwd` to work in."""
        self._told, theirs = socket.socketpair()
        with theirs:
            with _ONE:
                template = _template()
            socket.send_fds(template, [b"e" if arguments[0] in EVALUATION else b"."], [theirs.fileno()])
        named = {name: str(path.absolute()) for name, path in files.items()}
        command = {"arguments": arguments, "environment": environment, **named}
        self._told.sendall(json.dumps(command).encode() + b"\n")
        self._lines = self._told.makefile()
        self.pid = self._told_number()
        self.returncode: int | None = None

    def poll(self) -> int | None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self.wait(0)
        return None

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is None:
            if not select.select([self._told], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired("specshield", timeout or 0)
            self.returncode = self._told_number()
            self._lines.close()
            self._told.close()
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def _told_number(self) -> int:
        line = self._lines.readline()
        assert line, "the process that tests are forked from has ended; its output says why"
        return int(line)


def _environment() -> dict[str, str]:
    """This process's, without what would join a server to the developer's own."""
    return {k: v for k, v in os.environ.items() if not k.startswith("SPECSHIELD_") and k != "REDIS_URL"}


@cache
def _template() -> socket.socket:
    """Begun with this process's first server. It ends with this process, which closes the socket."""
    control, theirs = socket.socketpair()
    with theirs:
        program = [sys.executable, "-m", "tests.template"]
        subprocess.Popen(program, cwd=Path(__file__).parents[1], stdin=theirs.fileno(), env=_environment())
    return control


@dataclass
class RunningServer:
    url: str
    data_dir: Path
    process: subprocess.Popen[bytes] | Forked
    log: Path

    def kill(self) -> None:
        """SIGKILL: no chance to clean up."""
        self.process.kill()
        self.process.wait()


# [s] after which a test that hangs is given up. Nothing that works takes so long, on however busy a machine:
# not even a policy, which its worker makes at a low priority.
HUNG = 900.0

# A file of which byte P is locked, to its end, by the process of tests that has handed out port P.
_HANDED_OUT = Path(tempfile.gettempdir(), f"specshield-test-ports-{os.getuid()}")


@cache
def _handed_out() -> tuple[Iterator[int], IO[bytes]]:
    """The ports below those that Linux gives to outgoing connections (32768 and up), in an order of this
    process's own, and the file. It is opened once: to close any handle of it would give up all locks of this
    process.
    """
    ports = random.SystemRandom().sample(range(20_000, 32_000), 12_000)
    return itertools.cycle(ports), open(_HANDED_OUT, "ab")


def free_port() -> int:
    """A port that is free now, and that no process of tests hands out again while this one runs.

    To find a port free is not enough: a server takes a second to listen, and the tests of another process
    may find the same one free meanwhile. The kernel's own choice (port 0) may be the same twice before the
    first is in use, and may be taken by an outgoing connection of another test.
    """
    ports, handed_out = _handed_out()
    for port in itertools.islice(ports, 12_000):
        with socket.socket() as probe, contextlib.suppress(OSError):
            fcntl.lockf(handed_out, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, port)
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
            return port
    raise OSError("no port from 20000 to 31999 is free")


# A server with one of these has an interpreter of its own, since the template read them when it began. So has
# one on a cluster: `specshield.service.training` looks for that, and for no other store, at its import.
READ_AT_IMPORT = {"NUMBA_CACHE_DIR", "PYTHONPATH", "SPECSHIELD_MAPS_DIR", "SPECSHIELD_MODELS_DIR"}

# Variables for forks: a folder of packages that are found as if they were installed, and whether the
# processes that drive a command's robots are forked too.
ADDED, ROBOTS = "ADDED_PACKAGES", "FORKED_ROBOTS"


@contextmanager
def serving(
    data_dir: Path, *options: str, ready: bool = True, port: int = 0, **environment: str
) -> Iterator[RunningServer]:
    """`specshield serve`. port: 0 is a free one. environment: settings, as in SPECSHIELD_SESSION_TTL="1"."""
    port = port or free_port()
    data_dir.mkdir(parents=True, exist_ok=True)
    log = data_dir / "server.log"
    arguments = ["serve", "--port", str(port), *options]
    settings = {
        **_environment(),
        "SPECSHIELD_DATA_DIR": str(data_dir),
        "SPECSHIELD_WORKER": "false",
        "TMPDIR": str(data_dir),  # what a killed server leaves goes with the test
        **environment,
    }
    if READ_AT_IMPORT & environment.keys() or "+cluster:" in environment.get("REDIS_URL", ""):
        program = [sys.executable, "-m", "specshield.cli", *arguments]
        with open(log, "ab") as output:
            process = subprocess.Popen(
                program, env=settings, stdin=subprocess.DEVNULL, stdout=output, stderr=output
            )
    else:
        process = Forked(arguments, settings, stdout=log, stderr=log, cwd=Path.cwd())
    server = RunningServer(f"http://127.0.0.1:{port}", data_dir, process, log)
    try:
        if ready:
            wait_ready(server)
        yield server
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(HUNG)
        except subprocess.TimeoutExpired:
            server.kill()
            raise AssertionError("the server did not stop when it was told to") from None


def run_specshield(
    *arguments: object, cwd: Path | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """`specshield`, forked, to its end. environment: settings beside this process's variables."""
    with tempfile.TemporaryDirectory() as folder:
        out, err = Path(folder, "stdout"), Path(folder, "stderr")
        words, given = [str(each) for each in arguments], {**_environment(), **environment}
        process = Forked(words, given, stdout=out, stderr=err, cwd=cwd or Path.cwd())
        try:
            code = process.wait(HUNG)
        finally:
            process.kill()
        return subprocess.CompletedProcess(words, code, out.read_text(), err.read_text())


def wait_ready(server: RunningServer) -> None:
    """However long that takes: a first start compiles. AssertionError where the server ends or gives up."""
    status = 0
    # httpx.get reads all certificates each time: 20 ms
    with httpx.Client(timeout=HUNG, verify=False) as client:
        while status != 200:
            assert server.process.poll() is None, server.log.read_text()[-4000:]
            assert status != 500, server.log.read_text()[-4000:]
            time.sleep(0.05)
            with contextlib.suppress(httpx.TransportError):
                status = client.get(f"{server.url}/readyz").status_code


def children(pid: int) -> list[int]:
    """Whatever process it has begun that still runs, whichever of its threads began it."""
    return [child.pid for child in psutil.Process(pid).children()]


def runs(pid: int) -> bool:
    """Whether a process is there, and is no zombie."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def command_line(pid: int) -> str:
    """What it was begun with, and its name, as one line. Empty where it has ended."""
    with contextlib.suppress(psutil.NoSuchProcess):
        process = psutil.Process(pid)
        return " ".join([*process.cmdline(), process.name()])
    return ""


def wait_for(condition: Callable[[], object]) -> None:
    """Asks again after 50 ms, and less often the longer it takes: to ask may cost some ms of a processor."""
    deadline, pause = time.monotonic() + HUNG, 0.05
    while not condition():
        assert time.monotonic() < deadline, f"not within {HUNG} s"
        time.sleep(pause)
        pause = min(1.2 * pause, 0.25)
