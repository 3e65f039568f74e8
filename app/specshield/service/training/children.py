"""What a server process keeps running beside itself: the embedded store, and a training worker."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import logging
import subprocess
import sys

from specshield.errors import SpecshieldError
from specshield.policy.methods import available
from specshield.service.settings import Settings
from specshield.service.startup import Startup
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.keeper import private

CHECK_EVERY = 0.25  # [s] between two looks whether they still run
log = logging.getLogger("specshield")


class TrainingWorker:
    """The worker of a data folder. There is at most one, however many servers share the folder: it holds a
    lock as long as it runs. It ends with the server that started it.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._methods: list[str] = []
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def methods(self) -> list[str]:
        """The methods of the worker that this server has started. Those of a later one are in the store."""
        return self._methods if self._alive else []

    @property
    def _alive(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def ensure(self) -> None:
        """Starts the worker, unless this server or another one has started it already."""
        if self._alive:
            return
        self._settings.data_dir.mkdir(parents=True, exist_ok=True)
        path = self._settings.data_dir / "worker.lock"
        with open(path, "ab", opener=private) as lock, contextlib.suppress(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._methods = available() if self._process is None else []
            # It ends with this process: its standard input is a pipe from here.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "specshield.cli", "worker", "--until-eof"],
                env=self._settings.environment(),
                stdin=subprocess.PIPE,
                pass_fds=[lock.fileno()],
                start_new_session=True,
            )

    def stop(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(5.0)


async def tend(embedded: EmbeddedStore | None, worker: TrainingWorker | None, startup: Startup) -> None:
    """Until it is cancelled, starts the store again if it died, and the worker once the server is ready."""
    while True:
        try:
            if embedded is not None and not embedded.joined():
                log.warning("the embedded store is gone; starting it again")
                await asyncio.to_thread(embedded.join)
            if worker is not None and startup.ready:
                worker.ensure()
        except (SpecshieldError, OSError) as error:
            log.error("%s", error)
            await asyncio.sleep(2.0)
        await asyncio.sleep(CHECK_EVERY)
