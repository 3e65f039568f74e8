"""What a server does until it is ready, and how it tells its progress.

    python -m specshield.service.startup     # does the same without a server, as for an image

The first start of an installation compiles the kernels, in one process for each part, and keeps them on the
disk. Later starts take them from there. Of several server processes one compiles, and the others wait for it.
The kernels that only some sessions need are compiled once the server is ready, at a low priority.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import gc
import logging
import os
import sys
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from specshield import compiled
from specshield.cores import cores
from specshield.errors import InputError, ServerError, SpecshieldError, Starting, Stopping, StoreError
from specshield.service import warmup
from specshield.service.storage.connect import with_cause
from specshield.service.storage.keeper import private

# The file `ready` (`compiled.mark`) says that every kernel of a start is on the disk; the file `complete`,
# that the kernels that only some sessions need are there too.
READY, COMPLETE = "ready", "complete"
KERNELS = 230  # on the disk once a first start is ready: `find $NUMBA_CACHE_DIR -name "*.nbi" | wc -l`
TAKES = 70  # [s] of a first start on two quiet cores; 19 to 73 were measured (`make wheels` prints it)
TELL_EVERY = 5.0  # [s] between two lines of the log
LOW = 10  # niceness of compiling in the background: with 19 it makes no progress beside 8 busy programs
NEARLY = 1.0  # [s] to wait for readiness before listening; chosen by hand
CHECK_EVERY = 0.25  # [s] between two looks whether another process has compiled them, or is ready
# [objects] that are new before a collection looks for cycles among them. With Python's 700 that took 18 us of
# a step and found none; with this number it takes 4 (gc.callbacks under `benchmarks.step_cost --robots 16`).
YOUNG = 7_000
_SHARED = "PROMETHEUS_MULTIPROC_DIR"  # names the folder that a server's processes share
log = logging.getLogger("specshield")


class Processes:
    """What the processes of a server with --workers tell each other of their start, and for as long as they
    live: each holds a lock on a file `<pid>.<state>`, in a folder that they share.
    """

    _told: int | None = None  # the descriptor of the locked file

    def tell(self, state: str) -> None:
        """Replaces what this process has told before."""
        if _SHARED in os.environ:
            path, before = Path(os.environ[_SHARED], f"{os.getpid()}.{state}"), self._told
            self._told = os.open(path, os.O_RDWR | os.O_CREAT)
            fcntl.flock(self._told, fcntl.LOCK_EX)
            if before is not None:
                fcntl.flock(before, fcntl.LOCK_UN)  # a forked process may have it too
                os.close(before)

    def any(self, state: str) -> bool:
        """Whether any of them is in this state."""
        return _SHARED in os.environ and any(map(_is_locked, Path(os.environ[_SHARED]).glob(f"*.{state}")))


def _is_locked(path: Path) -> bool:
    with open(path, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


@dataclass
class Startup:
    """The progress of a server's start.

    stopping: whether the server was told to stop. failure: why it cannot become ready. compiling: whether
    kernels may be missing on the disk. parts: the parts of the kernels that this start has compiled.
    completing: whether it may still compile those of warmup.LATER.
    """

    ready: bool = False
    stopping: bool = False
    failure: str | None = None
    compiling: bool = False
    parts: list[str] = field(default_factory=list)
    completing: bool = False
    processes: Processes = field(default_factory=Processes)

    def has(self, part: str) -> bool:
        """Whether the kernels of a part of warmup.LATER are compiled, or no process is going to compile them.
        True for any other name. Of several server processes, one that waits for another to compile does not
        know of a part before all are compiled.
        """
        return part not in warmup.LATER or not self.completing or part in self.parts

    def problem(self) -> SpecshieldError | None:
        """Why requests should not come here: the server is not ready yet, or about to stop. Else None."""
        if self.stopping:
            return Stopping("the server is about to stop", expected="another server behind the same address")
        if self.ready:
            return None
        if self.failure is not None:
            return ServerError(self.failure)
        expected = "a server that is ready: ask again, or wait until /readyz answers 200"
        if not self.compiling:
            return Starting("the server is starting", expected=expected)
        return Starting(
            f"the server is starting: {_progress()}; all of them, at the first start of an installation, "
            f"take about {TAKES} s",
            expected=expected,
            kernels={"compiled": on_disk(), "expected": KERNELS},
            parts={part: "done" if part in self.parts else "compiling" for part in warmup.PARTS},
        )


def on_disk() -> int:
    """How many of the kernels that a start needs are on the disk, by this start or an earlier one."""
    return min(compiled.on_disk(), KERNELS)


def _progress() -> str:
    """How far the compiling is. Kernels of an earlier version are on the disk until they are replaced."""
    if on_disk() == KERNELS:
        return "the kernels are on the disk, and those of an earlier version are compiled anew"
    return f"{on_disk()} of about {KERNELS} kernels are compiled"


async def until_it_may_listen(startup: Startup, prepared: asyncio.Task[Any]) -> None:
    """Returns when the server is ready or, if that takes longer, when it may take requests all the same: it
    then answers that it is starting. It may not while another process is ready, which answers them all.
    """

    def done(_: object) -> None:
        if startup.ready:
            startup.processes.tell("ready")

    prepared.add_done_callback(done)
    await asyncio.wait([prepared], timeout=NEARLY)
    while not prepared.done() and startup.processes.any("ready"):
        await asyncio.wait([prepared], timeout=CHECK_EVERY)
    if not startup.ready:
        startup.processes.tell("starting")


async def prepare(startup: Startup, check: Callable[[], object] = bool) -> None:
    """Returns when the server is ready, or cannot become ready with its settings. Raises what keeps it from
    that now, such as a lack of processes, and may pass.

    check: raises what keeps the server from serving, or StoreError while that is not known. It blocks.
    """
    gc.freeze()  # excludes 300,000 permanent objects from collections, which would take 0.2 s with them
    gc.enable()
    try:
        mark = compiled.mark(READY)
        if mark is not None and not mark.exists():
            startup.compiling = True
            telling = asyncio.create_task(_tell())
            try:
                await _compile(startup, warmup.PARTS, mark, cores())
            finally:
                telling.cancel()
        for part in warmup.PARTS:  # takes the kernels from the disk, and compiles those that are not there
            await asyncio.to_thread(warmup.warm_up, part)
        gc.freeze()  # the objects of the kernels are permanent too
        gc.set_threshold(YOUNG, 10, 10)
        said = ""
        while True:
            try:
                await asyncio.to_thread(check)
                break
            except StoreError as error:
                if said != (said := str(with_cause(error))):
                    log.warning("not ready yet, and trying again: %s", said)
            await asyncio.sleep(CHECK_EVERY)
        startup.ready = True
        log.info("ready")
    except InputError as error:
        log.error("%s", error)
        startup.failure = str(error)
    except Exception as error:
        startup.failure = f"the server cannot become ready now: {type(error).__name__}; its log says more"
        raise


async def complete(startup: Startup, at_once: int = 1, nice: int = LOW) -> bool:
    """Once the server is ready, compiles the kernels that only some sessions need, in `at_once`
    processes. Else their first decision would compile them, while all others wait. False if some are missing.
    """
    startup.completing = True
    try:
        mark = await asyncio.to_thread(compiled.mark, COMPLETE)
        if mark is None or mark.exists():
            return True
        while not startup.ready:
            await asyncio.sleep(CHECK_EVERY)
        log.info("compiling, in the background, the kernels that only some sessions need")
        await _compile(startup, warmup.LATER, mark, at_once, nice)
        if mark.exists():
            return True
        log.warning("some kernels are not compiled: the first decision that needs one will wait for it")
    except Exception as error:  # as when there is no room for a file or a process
        log.warning("the other kernels cannot be compiled now: %r", error)
    finally:
        startup.completing = False
    return False


async def _compile(startup: Startup, parts: Iterable[str], mark: Path, at_once: int, nice: int = 0) -> None:
    """Compiles these parts, with a process for each and `at_once` at a time, and then makes the mark."""
    free = asyncio.Semaphore(at_once)
    async with _one_at_a_time(mark.with_suffix(".lock")):
        if mark.exists():  # another process has done it meanwhile
            return
        if all(await asyncio.gather(*(_compile_part(part, startup, free, nice) for part in parts))):
            mark.touch()


async def _compile_part(part: str, startup: Startup, free: asyncio.Semaphore, nice: int) -> bool:
    """Compiles a part in a process. False if that failed."""
    async with free:
        program = sys.executable, "-m", "specshield.service.warmup", part, str(nice)
        process = await asyncio.create_subprocess_exec(*program, stdin=asyncio.subprocess.PIPE)
        try:
            done = await process.wait() == 0
        finally:
            with contextlib.suppress(ProcessLookupError):  # it has ended already
                process.kill()
    if done:
        startup.parts.append(part)
    return done


async def _tell() -> None:
    log.info(
        "compiling the kernels that are not on the disk: all of them take about %d s on two quiet cores",
        TAKES,
    )
    while True:
        await asyncio.sleep(TELL_EVERY)
        log.info("%s", _progress())


@asynccontextmanager
async def _one_at_a_time(path: Path) -> AsyncIterator[None]:
    """Holds a lock on this file during the block. It would also end with this process."""
    with open(path, "ab", opener=private) as lock:
        while True:
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            await asyncio.sleep(CHECK_EVERY)
        yield


def main() -> None:
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    startup = Startup()
    try:
        asyncio.run(prepare(startup))
    except Exception:
        log.exception("the kernels cannot be compiled")
    if startup.ready and not asyncio.run(complete(startup, cores(), 0)):
        sys.exit("some kernels are not compiled; the lines above say why")
    sys.exit(startup.failure)


if __name__ == "__main__":
    main()
