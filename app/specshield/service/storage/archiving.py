"""The store and the archive as one: a session that has left the store is read from its file, and a change
brings it back into the store.

Two copies of a session never both go on, whatever process is killed and when:

- A session leaves the store once its file is on the disk, and only if its version is still the file's.
- A script brings it back, and refuses where the store has one already. For `FENCE` seconds the store also
  remembers with which version a session left, or that it was erased, and refuses any other version: so a slow
  server that read an older file comes too late.
- Where both the store and the archive have a session, the store's counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import islice
from typing import ParamSpec, TypeVar

import anyio

from specshield.service.storage.archive import Archive, Entry
from specshield.service.storage.store import (
    INDEX,
    PAGE_BYTES,
    Change,
    Dump,
    Record,
    Store,
    exists,
    keys,
    owner_of,
    scoped,
)

P = ParamSpec("P")
R = TypeVar("R")
TURN = "specshield:archive:"  # followed by the work: the name of the server whose turn it is
SIZES = "specshield:archive:sizes"  # a hash: the bytes of each owner's files
FENCE = 600  # [s]; longer than any server takes from reading a file to bringing it back. Chosen by hand.
TRIES = 5  # of reading a file that a newer one replaces, and of bringing a session back
AT_ONCE = 8  # reads and writes of files of one server process; more would wait for the same disk

# A store whose memory is full runs a script to its end if the first write needs no memory. The scripts that
# have to run then, since they free memory, begin with such a write.

# KEYS of the next three: session, rows, steps, fence.  ARGV: version, FENCE.  Returns 1 if the session has
# left the store with this version, now or before; 0 if the store has a newer one; -1 if it was erased.
LEAVE = """\
local version, fence = redis.call('HGET', KEYS[1], 'version'), redis.call('GET', KEYS[4])
if version and version ~= ARGV[1] then return 0 end
if not version then return (not fence or fence == ARGV[1]) and 1 or -1 end
redis.call('UNLINK', KEYS[1], KEYS[2], KEYS[3])
redis.call('SET', KEYS[4], ARGV[1], 'EX', ARGV[2])
return 1"""

# ARGV: version, FENCE, time to live [ms], config, state, rows, steps...  Returns 1 if the session is back.
RETURN = """\
local fence = redis.call('GET', KEYS[4])
if redis.call('EXISTS', KEYS[1]) == 1 or (fence and fence ~= ARGV[1]) then return 0 end
redis.call('UNLINK', KEYS[2], KEYS[3])
redis.call('HSET', KEYS[1], 'version', ARGV[1], 'config', ARGV[4], 'state', ARGV[5])
redis.call('SET', KEYS[2], ARGV[6])
for i = 7, #ARGV do redis.call('RPUSH', KEYS[3], ARGV[i]) end
for i = 1, 3 do redis.call('PEXPIRE', KEYS[i], ARGV[3]) end
return 1"""

# ARGV: '', FENCE.  Returns 1 if there was a session.
ERASE = """\
local found = redis.call('UNLINK', KEYS[1], KEYS[2], KEYS[3])
redis.call('SET', KEYS[4], 'erased', 'EX', ARGV[2])
return found > 0 and 1 or 0"""

# ARGV: name, time to live [s].  Returns 1 unless the key holds another name: it then holds this one.
TAKE = """\
if (redis.call('GET', KEYS[1]) or ARGV[1]) ~= ARGV[1] then return 0 end
redis.call('PERSIST', KEYS[1])
redis.call('SET', KEYS[1], ARGV[1], 'EX', ARGV[2])
return 1"""
COUNT = "redis.call('PERSIST', KEYS[1]) return redis.call('HINCRBY', KEYS[1], ARGV[1], ARGV[2])"


class ArchivingStore(Store):
    """A `Store` whose sessions may also lie in the archive. `count` counts only those in the store. archived:
    the bytes of each owner's files there, as the mover last read them.
    """

    def __init__(self, url: str, timeout: float, ttl: int, archive: Archive, replicas: int = 0) -> None:
        super().__init__(url, timeout, ttl, replicas)
        self.archive = archive
        made = map(self.redis.register_script, (LEAVE, RETURN, ERASE, TAKE, COUNT))
        self._leave, self._return, self._erase, self._take, self._count = made
        self.archived: dict[str, int] = {}
        self._files = anyio.CapacityLimiter(AT_ONCE)

    async def create(self, id: str, config: bytes, change: Change, *limits: tuple[str | None, int]) -> bytes:
        if await self.file(id) is not None and not await self._was_erased(id):
            raise exists(id)
        return await super().create(id, config, change, *limits)

    async def load(self, id: str, t: int | None = None) -> Record | None:
        """Two round trips and a file where the session is not in the store."""
        if (found := await super().load(id, t)) is not None:
            return found
        dump = await self._in_archive(id)
        if dump is None:  # or it has just come back
            return await super().load(id, t)
        step = dump.steps[t] if t is not None and t < len(dump.steps) else None
        return Record(dump.config, dump.state, dump.version, dump.rows, step or None)

    async def append(self, id: str, version: bytes, change: Change) -> bytes | Record | None:
        """As `Store.append`. A session in the archive is brought back, and again if it moves meanwhile."""
        for _ in range(TRIES):
            found = await super().append(id, version, change)
            if found is not None or not await self._bring_back(id):
                return found
        return await super().append(id, version, change)

    async def dump(self, id: str) -> Dump | None:
        found = await super().dump(id)
        return found if found is not None else await self._in_archive(id)

    async def file(self, id: str) -> Entry | None:
        """The file of a session in the archive. As long as it is the same, so is what is in it."""
        return await self.in_thread(self.archive.find, id)

    async def delete(self, id: str) -> bool:
        """Erases a session in store and archive. False if there was none."""
        await self.in_thread(self.archive.entries, id)  # if the files are away, nothing is erased
        async with self._reaching():
            found = await self._erase(keys=_keys(id), args=["", FENCE])
            await self.take_off([id.encode()])
        if size := await self.in_thread(self.archive.erase, id):
            await self.count_bytes(owner_of(id), -size)
        await self.follow()
        return bool(size or found)

    async def everything(
        self, owner: str, after: str | None, limit: int
    ) -> tuple[list[tuple[bytes, bytes]], str | None]:
        """(config, state) of an owner's next sessions after an id, in store and archive, at most `limit`; and
        the id after which the next page begins, None on the last page.
        """
        prefix = scoped(owner, "")
        async with self._reaching():
            low, high = f"({prefix}{after or ''}", f"({owner}A"  # A follows @
            running = {id.decode() for id in await self.redis.zrangebylex(INDEX, low, high, 0, limit)}
        entries = self.archive.after(owner, after)  # after the store: a session may leave it meanwhile
        archived = await self.in_thread(lambda: {each.key: each for each in islice(entries, limit)})
        ids = sorted(running | archived.keys())[:limit]
        async with self._reaching():
            fit, room = await self._that_fit(ids, PAGE_BYTES)
            more, ids = len(ids) == limit or len(fit) < len(ids), fit
            live = await self._of_each(ids, "hmget", "config", "state")
        found: list[tuple[bytes, bytes]] = []
        for id, (config, state) in zip(ids, live, strict=True):
            after = id.removeprefix(prefix)
            if config is not None:
                found.append((config, state))
                continue
            kept = None if id in running else archived.get(id)  # one that has just left has a newer file
            entry = kept or await self.file(id)
            head = None if entry is None else await self.in_thread(self.archive.head, entry)
            if head is not None:
                found.append(head)
                room -= len(head[0])
                if room <= 0:
                    return found, after
        return found, after if more else None

    async def idle(
        self, after: str | None, limit: int, least: float
    ) -> tuple[list[tuple[str, float, bytes]], str | None]:
        """Looks at the next `limit` sessions in the store after an id. Returns (id, seconds, state) of those
        that have not changed for `least` seconds, and the id after which to go on, None at the end.
        """
        async with self._reaching():
            low = "-" if after is None else f"({after}"
            ids = [id.decode() for id in await self.redis.zrangebylex(INDEX, low, "+", 0, limit)]
            left = await self._of_each(ids, "pttl")  # every change sets it anew
            waits = {id: self._ttl - ms / 1000 for id, ms in zip(ids, left, strict=True) if ms >= 0}
            idle = [id for id, seconds in waits.items() if seconds >= least]
            states = await self._of_each(idle, "hget", "state")
            expired = [id.encode() for id, ms in zip(ids, left, strict=True) if ms == -2]
            if expired:
                await self.take_off(expired)
        found = [(id, waits[id], state) for id, state in zip(idle, states, strict=True) if state is not None]
        return found, ids[-1] if len(ids) == limit else None

    async def my_turn(self, what: str, name: str, seconds: int) -> bool:
        """Whether it is now the turn of `name` at this work: no other name had one in the last `seconds`."""
        async with self._reaching():
            return bool(await self._take(keys=[TURN + what], args=[name, seconds]))

    async def count_bytes(self, owner: str, more: int) -> None:
        """Adds `more` to the bytes that an owner has in the archive."""
        async with self._reaching():
            await self._count(keys=[SIZES], args=[owner, more])

    async def sizes(self) -> dict[str, int]:
        """The bytes that each owner has in the archive: those of the last count, and what moved since."""
        async with self._reaching():
            return {owner.decode(): int(size) for owner, size in (await self.redis.hgetall(SIZES)).items()}

    async def correct(self, sizes: Mapping[str, int]) -> None:
        """Makes these the bytes that each owner has in the archive."""
        counted = await self.sizes()
        for owner in counted.keys() | sizes.keys():
            await self.count_bytes(owner, sizes.get(owner, 0) - counted.get(owner, 0))

    async def put_away(self, id: str, expires: float, dump: Dump) -> bool:
        """Moves a session to the archive. False if the store has a newer version, or it was erased."""
        entry, size = await self.in_thread(self.archive.put, id, expires, dump)
        async with self._reaching():
            left = await self._leave(keys=_keys(id), args=[dump.version, FENCE])
            if left > 0:
                await self.take_off([id.encode()])
        if left > 0:
            size -= await self.in_thread(self.archive.erase, id, entry)
        else:
            await self.in_thread(self.archive.remove, entry)
            size = 0
        await self.count_bytes(owner_of(id), size)
        return bool(left > 0)

    async def _bring_back(self, id: str) -> bool:
        """Brings a session back from the archive. False if the archive does not have it."""
        dump = await self._in_archive(id)
        if dump is None:
            return False
        contents = [dump.config, dump.state, dump.rows, *dump.steps]
        await self.list_name(id)
        async with self._reaching():
            await self._return(keys=_keys(id), args=[dump.version, FENCE, self._ttl * 1000, *contents])
        await self.list_name(id)
        return True

    async def _in_archive(self, id: str) -> Dump | None:
        dump = await self.in_thread(self._archived, id)
        return None if dump is None or await self._was_erased(id) else dump

    async def _was_erased(self, id: str) -> bool:
        """Whether a session was erased in the last `FENCE` seconds, and none of its id has left the store
        since. A file of it that is found all the same was written meanwhile. Whoever wrote it removes it;
        lists may name it until then. If that server has died, the session is back after `FENCE` seconds.
        """
        async with self._reaching():
            return bool(await self.redis.get(_keys(id)[-1]) == b"erased")

    def _archived(self, id: str) -> Dump | None:
        for _ in range(TRIES):
            entry = self.archive.find(id)
            dump = None if entry is None else self.archive.read(entry)
            if entry is None or dump is not None:
                return dump
        return None

    async def in_thread(self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        return await anyio.to_thread.run_sync(lambda: function(*args, **kwargs), limiter=self._files)


def _keys(id: str) -> list[str]:
    return [*keys(id), f"specshield:{{{id}}}:left"]
