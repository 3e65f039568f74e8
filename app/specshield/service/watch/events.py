"""Each decision of a session as it is made, for whoever watches: made here, or by any other server.

A step pays nothing for its watchers. Each server process asks the store which of the sessions watched here
have gone on, ten times a second and a part of them at a time, and reads what is new once for all who watch.
A watcher who is behind reads the stored steps itself, a few at a time.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from specshield.errors import LimitReached, NotFound, SpecshieldError
from specshield.service import metrics
from specshield.service.access.owners import shown
from specshield.service.schemas.answers import to_json
from specshield.service.sessions import record, rules
from specshield.service.sessions.session import Session, describe, missing
from specshield.service.sessions.state import State
from specshield.service.storage.store import News, Store

EVERY = 0.1  # [s] between two looks at a session; chosen by hand: a page need not be quicker
TOGETHER = 0.25  # [s] between two messages of a stream of several sessions; by hand: each costs some 0.1 ms
PARTS = 4  # of the sessions, looked at one after the other, so that none of them holds up a decision
KEPT = 64  # events kept for the watchers of a session, and read at once
HEARTBEAT = 15.0  # [s] without an event; chosen by hand, below what proxies wait
FIRST = b"retry: 1000\n\n"
log = logging.getLogger("specshield")


@dataclass(frozen=True)
class Told:
    """A decision as it is told. session: its id. switch: events that come before it. asked: x_t, which of the
    session's rules held, and the logits, as members of a JSON object. answer: what was answered.
    """

    session: str
    t: int
    switch: bytes
    asked: bytes
    answer: bytes

    def event(self) -> bytes:
        return b"%sid: %d\ndata: %s\n\n" % (self.switch, self.t, self.answer)

    @cached_property
    def whole(self) -> bytes:
        """The event in a stream of several sessions: made once for all who watch."""
        head = b'{"session":"%s","t":%d,%s' % (self.session.encode(), self.t, self.asked)
        return b'data: %s,"decision":%s}\n\n' % (head, self.answer)


@dataclass(eq=False)
class Feed:
    """A session that is watched here. rules: those that it has had, `told` as the contract shows them. width:
    bytes of a row.

    recent: the decisions of the steps from `start` to before `end`. version: the one that was read; None for
    a session that is not in the store.
    """

    id: str
    rules: Sequence[Mapping[str, Any]]
    told: list[dict[str, Any]]
    width: int
    version: bytes | None
    start: int
    end: int
    over: bool
    status: str
    watchers: int = 0
    recent: deque[Told] = field(default_factory=lambda: deque(maxlen=KEPT))
    changed: asyncio.Event = field(default_factory=asyncio.Event)

    def add(self, state: State, found: list[Told], end: int) -> None:
        for each in found:
            if len(self.recent) == KEPT:
                self.start = self.recent[0].t + 1
            self.recent.append(each)
        self.end, self.over, self.status = end, state.finished and end >= state.next_t, state.spec_status
        self.wake()

    def wake(self) -> None:
        self.changed.set()
        self.changed = asyncio.Event()


class Watchers:
    """limit: of streams at once in this process. stopping: whether the server is on its way out."""

    def __init__(self, store: Store, limit: int, stopping: Callable[[], bool]) -> None:
        self._store, self._limit, self._stopping = store, limit, stopping
        self._feeds: dict[str, Feed] = {}
        self._open = 0

    async def run(self) -> None:
        """Looks at the sessions that are watched, until it is cancelled."""
        while True:
            feeds = list(self._feeds.values())
            for part in range(PARTS):
                await asyncio.sleep(EVERY / PARTS)
                try:
                    await self._look(feeds[part::PARTS])
                except SpecshieldError:
                    pass  # the store is away: what is missed is read when it is back
                except Exception:
                    log.exception("what is new in a session cannot be read")
            if self._stopping():
                for feed in feeds:
                    feed.wake()

    async def open(self, id: str, after: int | None) -> AsyncIterator[bytes] | None:
        """The stream of what follows step `after`, by default the last one decided; None where nothing will.

        Raises NotFound, LimitReached.
        """
        self._check_room()
        feed = self._feeds.get(id) or await self._begin(id)
        t = feed.end if after is None else after + 1
        if feed.over and t >= feed.end:
            return None
        return self._stream(feed, t)

    async def open_all(self, after: Mapping[str, int | None]) -> AsyncIterator[bytes]:
        """One stream of what follows in several sessions, each after its own step; those that are not there
        are left out. Raises LimitReached.
        """
        self._check_room()
        places = {}
        for id, t in after.items():
            with contextlib.suppress(NotFound):
                feed = self._feeds.get(id) or await self._begin(id)
                places[feed] = feed.end if t is None else t + 1
        return self._together(places)

    def _check_room(self) -> None:
        if self._open >= self._limit:
            raise LimitReached(
                f"this server has {self._limit} open streams of events",
                expected="room for one more: close one, or ask another server",
            )

    async def _together(self, after: dict[Feed, int]) -> AsyncIterator[bytes]:
        places = {self._feeds.setdefault(feed.id, feed): t for feed, t in after.items()}
        feeds, told_at = list(places), time.monotonic()
        with self._watching(feeds):
            yield FIRST
            while places and not self._stopping():
                told = []
                for feed, t in [(feed, t) for feed, t in places.items() if t < feed.end or feed.over]:
                    if t < feed.start:
                        found, t = await self._older(feed, t)
                    else:
                        found, t = [each for each in feed.recent if each.t >= t], max(t, feed.end)
                    told += [each.whole for each in found]
                    places[feed] = t
                    if feed.over and t >= feed.end:
                        told.append(_end_of(feed))
                        del places[feed]
                if told or time.monotonic() - told_at > HEARTBEAT:
                    told_at = time.monotonic()
                    yield b"".join(told) or b": alive\n\n"
                await asyncio.sleep(TOGETHER)

    @contextlib.contextmanager
    def _watching(self, feeds: Sequence[Feed]) -> Iterator[None]:
        for feed in feeds:
            feed.watchers += 1
        self._open += 1
        metrics.watchers.inc()
        try:
            yield
        finally:
            metrics.watchers.dec()
            self._open -= 1
            for feed in feeds:
                feed.watchers -= 1
                if not feed.watchers and self._feeds.get(feed.id) is feed:
                    del self._feeds[feed.id]

    async def _begin(self, id: str) -> Feed:
        found = await self._store.load(id)
        if found is None:
            raise missing(id)
        session = Session.of(found)
        state = session.state
        return Feed(
            id, *_ruled(session), found.version, state.next_t, state.next_t, state.finished, state.spec_status
        )

    async def _stream(self, feed: Feed, t: int) -> AsyncIterator[bytes]:
        feed = self._feeds.setdefault(feed.id, feed)
        with self._watching([feed]):
            yield FIRST
            while not self._stopping():
                changed = feed.changed
                if t < feed.start:
                    found, t = await self._older(feed, t)
                else:
                    found, t = [each for each in feed.recent if each.t >= t], max(t, feed.end)
                if found:
                    yield b"".join(each.event() for each in found)
                if t < feed.end:
                    continue
                if feed.over:
                    yield _end(feed)
                    return
                try:
                    await asyncio.wait_for(changed.wait(), HEARTBEAT)
                except TimeoutError:
                    yield b": alive\n\n"

    async def _look(self, feeds: list[Feed]) -> None:
        if not feeds:
            return
        versions = await self._store.versions([feed.id for feed in feeds])
        seen = zip(feeds, versions, strict=True)
        gone_on = [(feed, version) for feed, version in seen if feed.version != version]
        here = [(feed, version) for feed, version in gone_on if version is not None]
        if here:
            news = await self._store.news([(feed.id, feed.end, feed.width, KEPT) for feed, _ in here])
            for (feed, version), new in zip(here, news, strict=True):
                if new is None or not _outdated(feed, new) or not await self._switched(feed):
                    self._gone_on(feed, version, new)
        for feed, found in gone_on:
            if found is None:
                await self._left(feed)

    def _gone_on(self, feed: Feed, version: bytes, new: News | None) -> None:
        if new is None or _begun(version) != _begun(feed.version or version):
            feed.over = True  # erased, and perhaps another session of this id was begun
            feed.wake()
            return
        state, (found, end) = State.of(new.state), _events(feed, feed.end, new)
        feed.add(state, found, end)
        if end >= state.next_t:  # else there is more, for the next look
            feed.version = version

    async def _switched(self, feed: Feed) -> bool:
        """Reads the rules anew; what else is new is for the next look. False where the session is gone."""
        found = await self._store.load(feed.id)
        if found is None or _begun(found.version) != _begun(feed.version or found.version):
            return False
        feed.rules, feed.told, feed.width = _ruled(Session.of(found))
        return True

    async def _left(self, feed: Feed) -> None:
        """The session is no longer in the store: it was erased, or lies in the archive."""
        dump = await self._store.dump(feed.id)
        if dump is None:
            feed.over = True
            feed.wake()
        else:
            feed.rules, feed.told, feed.width = _ruled(Session.of(dump))
            new = News(dump.state, dump.rows[feed.end * feed.width :], dump.steps[feed.end :])
            feed.add(State.of(dump.state), *_events(feed, feed.end, new))
        feed.version = None

    async def _older(self, feed: Feed, t: int) -> tuple[list[Told], int]:
        """Decisions from step t on, and the step that follows them."""
        (new,) = await self._store.news([(feed.id, t, feed.width, KEPT)])
        if new is None:
            dump = await self._store.dump(feed.id)
            if dump is None:
                return [], feed.end
            feed.rules, feed.told, feed.width = _ruled(Session.of(dump))
            new = News(dump.state, dump.rows[t * feed.width :], dump.steps[t : t + KEPT])
        elif _outdated(feed, new):
            return [], t if await self._switched(feed) else feed.end
        found, end = _events(feed, t, new)
        return found, end if end > t else feed.end


def _events(feed: Feed, t: int, new: News) -> tuple[list[Told], int]:
    """The decisions of the steps from t on that `new` has, and the step that follows them. The first one
    after a switch brings the switch.
    """
    found = []
    switched = [rule for rule in feed.told[1:] if rule["from"] >= t]
    for i, step in enumerate(new.steps):
        if step:
            row = record.row_of(new.rows[i * feed.width : (i + 1) * feed.width])
            rule = rules.at(feed.rules, t + i)
            kept = record.decode(step)
            answer = to_json(record.answer(kept, row, feed.rules[rule]["actions"]))
            asked = {"pose": row[:3].tolist(), "rule": rule, "logits": record.logits_json(kept)}
            switch = b""
            while switched and switched[0]["from"] <= t + i:
                switch += b"event: switch\ndata: %s\n\n" % json.dumps(switched.pop(0)).encode()
            found.append(Told(shown(feed.id), t + i, switch, json.dumps(asked)[1:-1].encode(), answer))
    return found, t + len(new.steps)


def _outdated(feed: Feed, new: News) -> bool:
    """Whether the session has had a switch that the feed does not know of; its rows may be wider since."""
    return len(State.of(new.state).verdicts) >= len(feed.rules)


def _ruled(session: Session) -> tuple[Sequence[Mapping[str, Any]], list[dict[str, Any]], int]:
    """`Feed.rules`, `told` and `width`."""
    told = describe(session.rules, session.state)["rules"]
    return session.rules, told, 8 * session.rows.shape[1]


def _end_of(feed: Feed) -> bytes:
    """In a stream of several sessions."""
    told = {"session": shown(feed.id), "next_t": feed.end, "spec_status": feed.status, "finished": True}
    return b"data: %s\n\n" % json.dumps(told).encode()


def _end(feed: Feed) -> bytes:
    told = {"next_t": feed.end, "spec_status": feed.status, "finished": True}
    return b"event: end\ndata: %s\n\n" % json.dumps(told).encode()


def _begun(version: bytes) -> bytes:
    """What tells one session of an id from another."""
    return version.partition(b":")[0]
