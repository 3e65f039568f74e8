"""The heavy work of one server process: other processes read uploads, draw, and make slow decisions."""

from __future__ import annotations

import asyncio
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

from fastapi import Request

from specshield.cores import cores
from specshield.service.heavy.pool import Pool, Template, Turns
from specshield.service.problems import ClientGone, until_gone
from specshield.service.settings import Settings
from specshield.service.watch import logs

R = TypeVar("R")
# Niceness, chosen by hand: the server itself has 0, and the making of policies (`specshield worker`) 10 more.
DECISIONS_NICE, TASKS_NICE = 5, 10
WAITING = 16  # calls of one owner that may wait
MOST_WAITING = 1000  # decisions of one session, or sessions with the same policies that begin, that may wait
TASKS = 2  # uploads and pictures of one owner at once
OWNERS = 2  # One owner's calls keep at most 1 / OWNERS of a pool's processes busy. Chosen by hand.
DECISION_TIMEOUT = 30.0  # [s]; the slowest known step takes 1 s, and the first may compile its kernels
DECISION_MEMORY = 4 << 30  # [bytes]: for the tables of a few policies and of a look-ahead
IDLE = 60.0  # [s] after the last call until a child ends, and until the template ends after the last child


class Heavy:
    """tasks: the pool for uploads and pictures. decisions: the pool for slow decisions. One owner never has
    all processes of a pool: another one would wait for seconds, with a robot or for a small upload.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings, self._template = settings, Template()
        pool, size = partial(Pool, self._template, unused=self._unused), max(cores(), 2)
        self.tasks = pool(
            size=OWNERS * TASKS, memory=settings.heavy_memory, nice=TASKS_NICE, waiting=TASKS, idle=IDLE
        )
        self.decisions = pool(
            size=OWNERS * size, memory=DECISION_MEMORY, nice=DECISIONS_NICE, waiting=size, idle=10 * IDLE
        )
        # By owner: the turns among its tasks, and those of its sessions among its decisions.
        self._tasks = defaultdict[str, Turns](lambda: Turns(TASKS, WAITING))
        self._decisions = defaultdict[str, Turns](lambda: Turns(size, MOST_WAITING))

    async def run(self, request: Request, function: str, *arguments: Any) -> Any:
        """Calls a function of heavy/uploads.py, or of another module beside it as in "pictures:draw_policy",
        with the settings as its first argument. See `Pool.run`.

        If the caller closes the connection, this ends the work and raises ClientGone.
        """
        module, _, name = function.rpartition(":")
        asked = f"specshield.service.heavy.{module or 'uploads'}:{name}", self._settings, *arguments
        seconds, owner = self._settings.heavy_timeout, request.scope["state"]["owner"]
        call = self._tasks[owner].having(owner, self.tasks.run, *asked, seconds=seconds, owner=owner)
        work = asyncio.ensure_future(call)
        gone = asyncio.ensure_future(until_gone(request.receive))
        try:
            await asyncio.wait((work, gone), return_when=asyncio.FIRST_COMPLETED)
            if not work.done():
                raise ClientGone
            return work.result()
        finally:
            work.cancel()
            gone.cancel()
            await asyncio.gather(work, gone, return_exceptions=True)

    async def decide(self, function: Callable[..., R], *args: Any, session: str, key: Sequence[str]) -> R:
        """Calls a function with `Shields` of the other process first, when it is the session's turn among
        those of its owner.

        key: names what the process has to prepare, such as the policies: it is kept for further calls.
        """
        asked = "specshield.service.sessions.shields:call", self._settings, function, *args
        owner = logs.owner()
        limits = {"seconds": DECISION_TIMEOUT, "owner": owner, "key": tuple(key)}
        made: R = await self._decisions[owner].having(session, self.decisions.run, *asked, **limits)
        return made

    def _unused(self, since: float) -> None:
        asyncio.get_running_loop().call_later(since + IDLE - time.monotonic(), self._stop_if_unused)

    def _stop_if_unused(self) -> None:
        if self.tasks.children + self.decisions.children == 0:
            self._template.stop()

    def close(self) -> None:
        self.tasks.close()
        self.decisions.close()
        self._template.stop()
