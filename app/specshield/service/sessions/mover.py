"""Moves sessions that have ended, or have been idle for long, from the store to the archive, and erases
expired sessions there.

Every server has a mover; of the servers that share a store one moves at a time. Correctness does not depend
on that: two movers of the same session write the same file.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import time
from collections import Counter
from itertools import islice

import msgspec

from specshield.errors import SpecshieldError
from specshield.service.sessions.state import State
from specshield.service.settings import Settings
from specshield.service.storage.archiving import ArchivingStore
from specshield.service.storage.objects import left_out
from specshield.service.storage.store import owner_of, shown

BATCH = 1000  # ids, or files, that are looked at together
AT_ONCE = 4  # sessions that are moved at the same time; each waits for its file to be on the disk
ENDED = 60  # [s] that an ended session stays in the store, so that its last answers can be asked for again
EVERY = 10.0  # [s] between two looks at the store, at most
SWEEP_EVERY = 3600  # [s] between two looks at all files, at most
log = logging.getLogger("specshield")


class Mover:
    """While the archive is full, no session is moved."""

    def __init__(self, store: ArchivingStore, settings: Settings) -> None:
        self._store, self._after, self._ttl = store, settings.archive_after, settings.session_ttl
        self._room, self._ended = settings.archive_bytes, min(ENDED, settings.archive_after)
        self._me = secrets.token_hex(8)

    async def run(self) -> None:
        """Moves and sweeps until it is cancelled."""
        every, sweep_every = min(EVERY, self._ended), min(SWEEP_EVERY, self._ttl)
        while True:
            try:
                mine = await self._store.my_turn("turn", self._me, int(3 * every) + 1)
                if mine and await self._store.my_turn("sweep", secrets.token_hex(8), sweep_every):
                    await self._store.correct(await self.sweep())
                self._store.archived = await self._store.sizes()
                if mine and sum(self._store.archived.values()) < self._room:
                    await self.move()
            except SpecshieldError as error:
                log.warning("nothing moves to the archive now: %s", error)
            except Exception:  # the next turn may succeed; without a mover the store would only grow
                log.exception("nothing moves to the archive now")
            await asyncio.sleep(every)

    async def move(self) -> int:
        """Moves the sessions that are due, and returns their number."""
        moved, after = 0, None
        while True:
            idle, after = await self._store.idle(after, BATCH, self._ended)
            free = asyncio.Semaphore(AT_ONCE)
            moved += sum(await asyncio.gather(*(self._move(*each, free) for each in idle)))
            if after is None:
                return moved

    async def _move(self, id: str, seconds: float, state: bytes, free: asyncio.Semaphore) -> bool:
        """Moves a session if it is due. One whose state another version has stored in another form stays."""
        try:
            if seconds < self._after and not State.of(state).finished:
                return False
            async with free:
                dump = await self._store.dump(id)
                if dump is None:
                    return False
                return await self._store.put_away(id, State.of(dump.state).expires_at, dump)
        except msgspec.MsgspecError as error:
            left_out(f"session {shown(id)!r} does not move to the archive: {error}")
            return False

    async def sweep(self) -> Counter[str]:
        """Removes files that have expired and those that a newer one replaces. Returns the bytes that are
        left, by owner.
        """
        files, kept, left = self._store.archive.sizes(), None, Counter[str]()
        while batch := await self._store.in_thread(lambda: list(islice(files, BATCH))):
            for entry, size in batch:
                if entry.expires <= time.time():
                    await self._store.in_thread(self._store.archive.remove, entry)
                    continue
                if kept is not None and (kept.key, kept.beginning) == (entry.key, entry.beginning):
                    await self._store.in_thread(self._store.archive.remove, kept)
                kept = entry
                left[owner_of(entry.key)] += size
        return left
