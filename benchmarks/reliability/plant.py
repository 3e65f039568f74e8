"""Processes that are killed and started again: servers, stores, and what they left behind.

All of them listen on 127.0.0.1 or a unix socket only, in folders of their own, and end with this process.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

import httpx
import redis

from specshield.sim.service import follow_parent
from tests.serving import free_port

TICKS = os.sysconf("SC_CLK_TCK")
PAGE = os.sysconf("SC_PAGE_SIZE")
START = 1800.0  # [s] most that a start may take; kernels that are missing are compiled
LOOK = 0.02  # [s] between two looks at something that is waited for
UNSET = ("REDIS_URL", "PYTHONDONTWRITEBYTECODE")  # else each start compiles the sources, as no user's does
STOP = 60.0  # [s] most that an orderly stop may take


def wait_for(condition: Callable[[], object], seconds: float, what: str) -> None:
    """Looks every LOOK, after ten seconds ever more rarely. Raises TimeoutError: `what` did not happen."""
    began = time.monotonic()
    while not condition():
        waited = time.monotonic() - began
        if waited > seconds:
            raise TimeoutError(f"{what}: not within {seconds:.0f} s")
        time.sleep(LOOK if waited < 10.0 else min(1.0, waited / 100.0))


class Program:
    """One command that is started, killed, stopped and started again. Its output goes to `log`."""

    def __init__(self, command: list[str], log: Path, environment: dict[str, str] | None = None) -> None:
        self.command, self.log, self.environment = command, log, environment
        self.process: subprocess.Popen[bytes] | None = None

    def start(self, *more: str) -> None:
        """more: arguments of this start only."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with open(self.log, "ab") as output:
            self.process = subprocess.Popen(
                [*self.command, *more],
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                preexec_fn=follow_parent,
            )

    @property
    def pid(self) -> int:
        assert self.process is not None
        return self.process.pid

    def runs(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        """SIGKILL: no chance to clean up."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def stop(self) -> tuple[int, float]:
        """SIGTERM; the exit status and the seconds it took. Raises TimeoutExpired."""
        assert self.process is not None
        began = time.monotonic()
        self.process.terminate()
        return self.process.wait(STOP), time.monotonic() - began

    def end(self) -> None:
        if self.runs():
            self.signal(signal.SIGCONT)
            try:
                self.stop()
            except subprocess.TimeoutExpired:
                self.kill()


class Service(Program):
    """`specshield serve` on a port of its own, which it keeps over its deaths.

    environment: settings, as in SPECSHIELD_SESSION_TTL="1".
    """

    def __init__(self, data: Path, *options: str, **environment: str) -> None:
        self.data, self.port = data, free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._http = httpx.Client(base_url=self.url, timeout=20.0, trust_env=False, verify=False)
        kept = {k: v for k, v in os.environ.items() if not k.startswith("SPECSHIELD_") and k not in UNSET}
        data.mkdir(parents=True, exist_ok=True)
        super().__init__(
            [sys.executable, "-m", "specshield.cli", "serve", "--port", str(self.port), *options],
            data / "server.log",
            {**kept, "SPECSHIELD_DATA_DIR": str(data), "SPECSHIELD_WORKER": "false", **environment},
        )

    def __enter__(self) -> Service:
        self.start()
        try:
            self.wait_ready()
        except BaseException:
            self.end()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def ready(self) -> bool:
        if not self.runs():
            raise RuntimeError(f"the server ended:\n{self.log.read_text(errors='replace')[-3000:]}")
        with suppress(httpx.TransportError):
            return self._http.get("/readyz").status_code == 200
        return False

    def wait_ready(self) -> None:
        wait_for(self.ready, START, "a server that is ready")

    def store_pid(self) -> int:
        """The embedded store's. Raises redis.ConnectionError where it is away."""
        with redis.Redis(unix_socket_path=str(self.data / "store" / "socket"), socket_timeout=2.0) as found:
            return int(found.info("server")["process_id"])


class RedisServer(Program):
    """Debian's redis-server, as durable as the embedded store: every write is on disk before its answer."""

    def __init__(self, folder: Path, *options: str, port: int = 0) -> None:
        self.folder, self.port = folder, port or free_port()
        self.url = f"redis://127.0.0.1:{self.port}/0"
        folder.mkdir(parents=True, exist_ok=True)
        listening = ["--port", str(self.port), "--bind", "127.0.0.1", "--dir", str(folder)]
        durable = ["--appendonly", "yes", "--appendfsync", "always", "--save", ""]
        super().__init__(["redis-server", *listening, *durable, *options], folder / "redis.log")

    def __enter__(self) -> RedisServer:
        self.start()
        wait_for(self.answers, 30.0, "a store that answers")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def answers(self) -> bool:
        with suppress(redis.RedisError), redis.Redis(port=self.port, socket_timeout=2.0) as found:
            return bool(found.ping())
        return False


def children(pid: int) -> Iterator[int]:
    """Every process below this one, whichever of its threads began it."""
    for listed in Path(f"/proc/{pid}/task").glob("*/children"):
        found = list[str]()
        with suppress(OSError):
            found = listed.read_text().split()
        for child in map(int, found):
            yield child
            yield from children(child)


def parent(pid: int) -> int:
    return int(_stat(pid)[1])


def command_of(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def lives(pid: int) -> bool:
    """Whether the process is there, and is no zombie."""
    try:
        return _stat(pid)[0] != "Z"
    except OSError:
        return False


def cpu_seconds(pid: int) -> float:
    """User and system time of a process so far; 0 where it is gone."""
    try:
        found = _stat(pid)
    except OSError:
        return 0.0
    return (int(found[11]) + int(found[12])) / TICKS


def resident(pid: int) -> int:
    """Bytes of memory that a process holds; 0 where it is gone."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE
    except OSError:
        return 0


def _stat(pid: int) -> list[str]:
    """The fields of /proc/<pid>/stat after the name."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


@contextmanager
def small_disk(folder: Path, megabytes: int) -> Iterator[Path]:
    """A file system of this size, mounted at `folder`. Raises PermissionError where none may be mounted."""
    folder.mkdir(parents=True, exist_ok=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(folder)], capture_output=True
    )
    if mounted.returncode:
        raise PermissionError(mounted.stderr.decode().strip())
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=False)
