"""Sessions in a store of the Redis protocol. The store handles bytes; service/sessions knows what they mean.

A session has three keys in one slot that expire together: `specshield:v2:{id}:session`, a hash of config,
state and version; `:rows`, its poses and signals; `:steps`, the list of the steps' records. The `id` of a
session is its key `owner@id`, so two owners may choose the same id, and nobody finds the session of another
owner. The owner is the name of the API key that made it, or "" if the server asks for no key or the key was
that of SPECSHIELD_API_KEY. The ids are also in `specshield:sessions`, a sorted set in which the sessions of
one owner stand together; it may still name sessions that have expired.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import defaultdict
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import anyio
import redis

from specshield.errors import LimitReached, SessionExists, StoreError
from specshield.service.storage.connect import connect, is_cluster, reaching
from specshield.service.storage.wire import Script, Wire
from specshield.service.storage.wires import Wires

PAGE_BYTES = 256 << 10  # of configs, on a page of a list; chosen by hand: read and shown in a few ms
AT_ONCE = 100  # commands of one pipeline, which the event loop writes and reads in about 2 ms
INDEX = "specshield:sessions"
Limit = tuple[str | None, int]  # the most sessions that an owner may have, or for None all owners together
NO_VERSION = b"-"  # a version that no session has
APPEND = Script(Path(__file__).with_name("append.lua").read_text())
# On Redis from 7.2 on, and on Valkey, WAIT waits only for what its own caller wrote: hence the SET. A store
# whose memory is full takes it after a PERSIST.
FOLLOW = Script("""\
redis.call('PERSIST', KEYS[1])
redis.call('SET', KEYS[1], '', 'EX', 60)
return ''""")
PING = Script("return redis.call('SET', KEYS[1], 1, 'EX', 60)")
# A script, since a store whose memory is full refuses all commands of a transaction, also those that read.
DUMP = """\
return {redis.call('HMGET', KEYS[1], 'config', 'state', 'version'), redis.call('GET', KEYS[2]),
    redis.call('LRANGE', KEYS[3], 0, -1)}"""


class Record(NamedTuple):
    """A session as one read saw it. rows: its history. step: the record of the step asked for, if any."""

    config: bytes
    state: bytes
    version: bytes
    rows: bytes
    step: bytes | None


class Dump(NamedTuple):
    """All of a session. steps: the record of each step, b"" for a step without a decision."""

    config: bytes
    state: bytes
    version: bytes
    rows: bytes
    steps: list[bytes]


class News(NamedTuple):
    """A session's state and version, and its rows and steps, as in `Dump`, from some step on."""

    state: bytes
    version: bytes
    rows: bytes
    steps: list[bytes]


class Change(NamedTuple):
    """One write: `rows` go to byte `offset`, `step` is the record of step `t`, `state` the new state. config:
    the new one, b"" to keep the stored one.
    """

    state: bytes
    rows: bytes = b""
    offset: int = 0
    t: int | None = None
    step: bytes = b""
    config: bytes = b""


class Store:
    """Every method raises StoreError if the store cannot be reached in time.

    replicas: how many replicas of the store need to have a change, or what was read, before a call returns.
    """

    def __init__(self, url: str, timeout: float, ttl: int, replicas: int = 0) -> None:
        self.redis: Any = connect(url, socket_timeout=timeout)
        self._claim = self.redis.register_script(Path(__file__).with_name("claim.lua").read_text())
        self._dump = self.redis.register_script(DUMP)
        self._in_cluster = is_cluster(url)
        self._wire: Wire | Wires = Wires(self.redis, timeout, replicas)
        if not self._in_cluster:
            self._wire = Wire(self.redis.connection_pool.make_connection, timeout, replicas)
        self._timeout, self._ttl, self._replicas = timeout, ttl, replicas
        self._sweeping = defaultdict[str | None, asyncio.Lock](asyncio.Lock)
        self._swept = dict[str | None, float]()

    async def aclose(self) -> None:
        self._wire.close()
        await self.redis.aclose()

    @asynccontextmanager
    async def _reaching(self) -> AsyncIterator[None]:
        """Sets one time limit for the block, waits and tries included. A failure becomes a StoreError."""
        with reaching(), anyio.fail_after(self._timeout):
            yield

    async def ping(self) -> None:
        """Checks that the store takes a write: a store whose disk is full still answers reads. In a cluster
        one master is enough, since sessions whose keys it has go on without the others.
        """
        writes, told = await self._test_writes(), None
        try:
            for write in asyncio.as_completed(writes):
                if (told := await write) is None:
                    return
        finally:
            for each in writes:
                each.cancel()
        assert told is not None
        raise told

    async def up(self) -> float:
        """The share of the store's masters that take a write: 1 or 0 for a single server."""
        told = await asyncio.gather(*await self._test_writes())
        return told.count(None) / len(told)

    async def _test_writes(self) -> list[asyncio.Task[StoreError | None]]:
        """For each master a write, which returns the error where the master does not take it."""

        async def write(key: str) -> StoreError | None:
            try:
                with reaching():
                    await self._wire.run(PING, [key], ())
            except StoreError as error:
                return error
            return None

        async with self._reaching():
            keys = await self._wire.of_each("specshield:ready")
        return [asyncio.create_task(write(key)) for key in keys]

    async def follow(self) -> None:
        """Returns once as many replicas as were asked for have all that was written before."""
        if self._replicas:
            async with self._reaching():
                keys = await self._wire.of_each("specshield:follow")
                await asyncio.gather(*(self._wire.run(FOLLOW, [key], ()) for key in keys))

    async def create(self, id: str, config: bytes, change: Change, *limits: Limit) -> bytes:
        """Creates a session and returns its first version. Raises SessionExists and LimitReached. `config`
        has to be unique, so that a second try recognizes the session that a first one created.
        """
        await self.list_name(id, *limits)
        begun = await self._write(id, b"", change._replace(config=config))
        if isinstance(begun, Record) and begun.config == config:  # by an earlier try whose answer was lost
            begun = begun.version
        if not isinstance(begun, bytes):
            raise exists(id)
        await self.list_name(id)
        return begun

    async def list_name(self, id: str, *limits: Limit) -> None:
        """Adds a session's name to the list before the session is created: else a server that is killed in
        between leaves a session that no list has. The name is added again afterwards, since names without a
        session are taken off the list. Raises LimitReached for a new name.
        """
        bounds = [part for limit in limits for part in (*_range(limit[0]), limit[1])]
        async with self._reaching():
            passed = await self._claim(keys=[INDEX], args=[id, *bounds])
        if passed:
            raise no_more(limits[passed - 1][1])

    async def take_off(self, ids: Sequence[bytes]) -> None:
        """Takes names without a session off the list. A session that is created meanwhile is listed again."""
        await self.redis.zrem(INDEX, *ids)
        gone = await self._gone(ids)
        if back := {id: 0 for id in ids if id not in gone}:
            await self.redis.zadd(INDEX, back)

    async def append(self, id: str, version: bytes, change: Change) -> bytes | Record | None:
        """Writes the change and returns the new version, in one round trip. If `version` is not the latest
        any more, writes nothing and returns the session with the record of step `change.t`, None if it is
        gone.
        """
        return await self._write(id, version, change)

    async def load(self, id: str, t: int | None = None) -> Record | None:
        """The session with the record of step t; None if there is no session. One round trip."""
        found = await self._write(id, NO_VERSION, Change(b"", t=t))
        assert not isinstance(found, bytes)
        return found

    async def _write(self, id: str, version: bytes, change: Change) -> bytes | Record | None:
        """A command that is lost on the way is sent again. An append that arrives twice is made once: the
        second one finds another version.
        """
        field = "" if change.t is None else change.t
        args: list[Any] = [version, change.offset, change.rows, field, change.step, change.state]
        args += (change.config, self._ttl * 1000, int(self._replicas > 0))
        with reaching():
            written = await self._wire.run(APPEND, keys(id), args)
        if isinstance(written, bytes):
            return written
        config, state, version, rows, step = written
        return None if config is None or rows is None else Record(config, state, version, rows, step or None)

    async def dump(self, id: str) -> Dump | None:
        """All of a session, as it is at one moment; None if there is no session."""
        async with self._reaching():
            (config, state, version), found, left = await self._dump(keys=keys(id))
        return None if config is None or found is None else Dump(config, state, version, found, left)

    async def count(self, owner: str | None) -> int:
        """How many sessions an owner has, or for None all owners; some may have expired."""
        low, high = _range(owner)
        async with self._reaching():
            return int(await self.redis.zlexcount(INDEX, low, high))

    async def sweep(self, owner: str | None) -> None:
        """Takes the names of expired sessions off the list, for an owner or for None all owners.

        With many names that takes seconds, so it is done once for all who ask while another one is at it.
        """
        asked = time.monotonic()
        async with self._sweeping[owner]:
            if self._swept.get(owner, -math.inf) < asked:
                began = time.monotonic()
                await self._sweep(owner)
                self._swept[owner] = began

    async def _sweep(self, owner: str | None) -> None:
        low, high = _range(owner)
        while True:
            async with self._reaching():
                ids = await self.redis.zrangebylex(INDEX, low, high, 0, AT_ONCE)
                if not ids:
                    return
                if gone := await self._gone(ids):
                    await self.take_off(gone)
                low = f"({ids[-1].decode()}"

    async def news(self, asked: Sequence[tuple[str, int, int, int]]) -> list[News | None]:
        """For each (id, t, bytes of a row, count) what the session has from step t on, for `count` steps."""
        async with self._reaching(), self.redis.pipeline(transaction=False) as pipe:
            for id, t, width, count in asked:
                session, rows, steps = keys(id)
                pipe.lrange(steps, t, t + count - 1)
                pipe.getrange(rows, t * width, (t + count) * width - 1)  # after the steps: has all their rows
                pipe.hmget(session, "state", "version")  # last: it shows a switch that made the rows wider
            found = await pipe.execute()
        three = zip(found[::3], found[1::3], found[2::3], strict=True)
        return [
            None if state is None else News(state, version, rows, steps)
            for steps, rows, (state, version) in three
        ]

    async def held_bytes(self) -> int | None:
        """The bytes of memory that the store takes; in a cluster all masters together, without replicas. None
        where the store does not say: a managed one may refuse the command.
        """
        async with self._reaching():
            with suppress(redis.ResponseError):
                if not self._in_cluster:
                    return int((await self.redis.info("memory"))["used_memory"])
                nodes = await self.redis.info("memory", target_nodes="primaries")
                return sum(int(node["used_memory"]) for node in nodes.values())
        return None

    async def _of_each(self, ids: Sequence[str], command: str, *fields: str) -> list[Any]:
        """The result of this command on each session's hash. One round trip, none without ids."""
        async with self.redis.pipeline(transaction=False) as pipe:
            for id in ids:
                getattr(pipe, command)(keys(id)[0], *fields)
            told: list[Any] = await pipe.execute() if ids else []
        return told

    async def _that_fit(self, ids: list[str], room: int) -> tuple[list[str], int]:
        """The first ids whose configs take about `room` bytes, at least one, and the bytes that are left."""
        for taken, size in enumerate(await self._of_each(ids, "hstrlen", "config"), start=1):
            room -= size
            if room <= 0:
                return ids[:taken], room
        return ids, room

    async def _gone(self, ids: Sequence[bytes]) -> list[bytes]:
        """The ids that have no session."""
        there = await self._of_each([id.decode() for id in ids], "exists")
        return [id for id, found in zip(ids, there, strict=True) if not found]


def _range(owner: str | None) -> tuple[str, str]:
    """The bounds of an owner's names in INDEX: owner@ to before ownerA (A follows @); for None, of all."""
    return ("-", "+") if owner is None else (f"[{owner}@", f"({owner}A")


def scoped(owner: str, id: str) -> str:
    """
    >>> scoped("alice", "run-1")
    'alice@run-1'
    """
    return f"{owner}@{id}"


def owner_of(key: str) -> str:
    """The owner in a session's key."""
    return key.partition("@")[0]


def shown(key: str) -> str:
    """The id, as callers know it, in a session's key."""
    return key.partition("@")[2]


def keys(id: str) -> list[str]:
    return [f"specshield:v2:{{{id}}}:{part}" for part in ("session", "rows", "steps")]


def no_more(most: int) -> LimitReached:
    expected = "room for one more: delete a session, or wait until one expires"
    return LimitReached(f"no more than {most} sessions are kept", expected=expected)


def exists(id: str) -> SessionExists:
    told = f"there is a session {shown(id)!r} already"
    return SessionExists(told, path="id", got=shown(id), expected="an id not in use")
