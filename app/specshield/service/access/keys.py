"""API keys, each with a name. The store holds their digests and limits; a key itself is shown only once.

The store has them in the hash `specshield:keys`, by name; its field "" gets a new token with each change. A
server keeps all keys in memory and asks every REFRESH seconds whether they have changed. So requests need no
round trip to the store, whatever key they show, and a revoked key works for no longer than that.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import math
import re
import secrets
import time
from collections.abc import Awaitable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec

from specshield.errors import InputError, LimitReached, NotFound, RateLimited, StoreError, Unauthorized
from specshield.service.library.files import now
from specshield.service.schemas.base import ID, ID_TOLD
from specshield.service.storage.connect import reaching

T = TypeVar("T")
KEYS = "specshield:keys"

REVOKE = "return redis.call('HDEL', KEYS[1], ARGV[1]) > 0 and redis.call('HSET', KEYS[1], '', ARGV[2])"
MOST_KEYS = 1000  # each takes some 300 bytes of every server's memory; chosen by hand
REFRESH = 2.0  # [s] for which a revoked key may still work; chosen by hand
MISS_EVERY = 0.2  # [s] between two looks at the store for unknown keys, at least; chosen by hand
MOST_STRANGE = 1000  # unknown keys that an open server remembers; chosen by hand
log = logging.getLogger("specshield")


@dataclass(frozen=True)
class Key:
    """digest: SHA-256 of the key in hex; since a key has 256 random bits, a plain hash is safe.

    requests: the most in a second, for each server process; steps are counted separately, up to the same
    number. sessions: the most that are kept. bytes: the most on the disk. None: the key has no such limit.
    """

    name: str
    digest: str
    created_at: str = ""
    requests: float | None = None
    sessions: int | None = None
    bytes: int | None = None


class Keys:
    """own: the key of SPECSHIELD_API_KEY, which has the empty name and no limits, unless the store has the
    same key (a command that starts a server may use one). store: a client of redis.asyncio. always: a key is
    asked for even if the store has none, as after it was emptied.
    """

    def __init__(self, store: Any, own: str | None = None, always: bool = False) -> None:
        self._store, self._lock = store, asyncio.Lock()
        self._own = {} if own is None else {digest_of(own.encode()): Key("", digest_of(own.encode()))}
        self._known: Mapping[str, Key] = self._own
        self._version: bytes | None = None
        self._always, self._strange = always, set[str]()  # the digests that an open server did not find
        self._read, self._tried_at = False, -math.inf
        self._changed = asyncio.Event()

    # --- for servers

    async def check(self, authorization: bytes) -> Key:
        """The key that a request shows. Raises Unauthorized, and StoreError if the keys are not known yet."""
        scheme, _, given = authorization.partition(b" ")
        # Looking up the digest takes a time that tells nothing about the key.
        digest = digest_of(given.strip()) if scheme.lower() == b"bearer" else ""
        found = self._known.get(digest)
        if found is None and digest not in self._strange and (given or not self._read):
            await self.refresh()
            found = self._known.get(digest)
        if found is None:
            if self._read and not (self._own or self._always) and self._version is None:
                if given:  # to look again at each request would hold each for MISS_EVERY
                    if len(self._strange) >= MOST_STRANGE:
                        self._strange.clear()
                    self._strange.add(digest)
                return OPEN
            if not (self._read or self._own):
                raise StoreError("the store cannot be reached, so the API keys are not known yet")
            what = "the API key is not one of this server's" if digest else "an API key is needed"
            expected = "Bearer <key>: the SDK sends its `api_key`, commands send SPECSHIELD_API_KEY"
            raise Unauthorized(what, path="Authorization", expected=expected)
        return found

    async def until_refused(self, authorization: bytes) -> None:
        """Returns once the key that a request showed is refused. It is checked after each change of keys."""
        with contextlib.suppress(Unauthorized):
            while True:
                changed = self._changed
                await self.check(authorization)
                await changed.wait()

    async def refresh(self) -> None:
        """Reads the keys if they have changed; calls within MISS_EVERY share one reading. While the store is
        away, the last reading counts. Once there has been a key, requests always need one.
        """
        asked_at = time.monotonic()
        async with self._lock:
            if self._tried_at >= asked_at:
                return
            await asyncio.sleep(max(0.0, self._tried_at + MISS_EVERY - time.monotonic()))
            began = time.monotonic()
            try:
                version = await _reached(self._store.hget(KEYS, ""))
                if version is None and self._version is not None:
                    version = b""  # the store was emptied
                if version is not None and version != self._version:
                    listed = {key.digest: key for key in await self.listed()}
                    self._known, self._version = {**self._own, **listed}, version
                    self._strange.clear()
                    self._changed.set()
                    self._changed = asyncio.Event()
                self._read = True
            except StoreError as error:
                log.debug("the keys could not be read: %s", error)
            self._tried_at = began

    async def follow(self) -> None:
        """Refreshes the keys until it is cancelled."""
        while True:
            try:
                await self.refresh()
            except Exception:  # the next one may succeed; without a next one no revoked key is refused
                log.exception("the keys cannot be read")
            await asyncio.sleep(REFRESH)

    # --- for the command line

    async def listed(self) -> list[Key]:
        found = await _reached(self._store.hgetall(KEYS))
        keys = (_read(name, record) for name, record in found.items() if name)
        return sorted((key for key in keys if key is not None), key=lambda key: key.name)

    async def create(self, name: str, **limits: Any) -> str:
        """Makes a key and returns it: it cannot be read again. Raises InputError and LimitReached."""
        if not re.fullmatch(ID, name):
            raise InputError("a key cannot have this name", path="name", got=name, expected=ID_TOLD)
        if await _reached(self._store.hlen(KEYS)) > MOST_KEYS:
            raise LimitReached(f"there are {MOST_KEYS} keys", expected="room for one more: revoke one")
        secret = f"ss_{secrets.token_urlsafe(32)}"
        record = msgspec.json.encode(Key(name, digest_of(secret.encode()), now(), **limits))
        if not await _reached(self._store.hsetnx(KEYS, name, record)):
            expected = "another name, or that key revoked first"
            raise InputError("there is a key of this name", path="name", got=name, expected=expected)
        await _reached(self._store.hset(KEYS, "", secrets.token_hex(8)))
        return secret

    async def revoke(self, name: str) -> None:
        """Revokes a key. What was made with it belongs to the next key of this name. Raises NotFound."""
        if not name or await _reached(self._store.eval(REVOKE, 1, KEYS, name, secrets.token_hex(8))) is None:
            raise NotFound("there is no such key", path="name", got=name, expected="a name in `keys list`")


class Rates:
    """Limits the requests that a key may make in a second. Steps have their own bucket of tokens, so that the
    robots of a key go on whatever else the key is used for. A bucket is the number of requests that were
    left, at most those of a second, and when that was [s].
    """

    def __init__(self) -> None:
        self._buckets: dict[tuple[str, bool], tuple[float, float]] = {}  # by the key's name, and for steps

    def take(self, key: Key, step: bool) -> None:
        """Counts a request. Raises RateLimited, with the seconds to wait."""
        rate = key.requests
        if rate is None:
            return
        now, most = time.monotonic(), max(1.0, rate)
        left, then = self._buckets.get((key.name, step), (most, now))
        left = min(most, left + (now - then) * rate)
        if left < 1.0:
            raise RateLimited(
                f"the key {key.name!r} may make {rate:g} requests in a second",
                expected="the request again after Retry-After",
                retry_after=math.ceil((1.0 - left) / rate),
            )
        self._buckets[key.name, step] = left - 1.0, now


OPEN = Key("", "")  # stands for all callers of a server that asks for no key


def _read(name: bytes, record: bytes) -> Key | None:
    """The key of a record. None, and a line in the log, for one that cannot be read: it opens nothing."""
    try:
        return msgspec.json.decode(record, type=Key)
    except msgspec.MsgspecError as error:
        log.error("the record of the key %r cannot be read, so it opens nothing: %s", name.decode(), error)
        return None


def digest_of(key: bytes) -> str:
    return hashlib.sha256(key).hexdigest()


async def _reached(answer: Awaitable[T]) -> T:
    with reaching():
        return await answer
