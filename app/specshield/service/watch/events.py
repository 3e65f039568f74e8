"""Streams of decisions for watchers, whichever server makes the decisions.

Watchers cost a step next to nothing: a decision of this process is only noted, and written once for all
watchers when their streams are served next. For sessions that other processes decide, each server process
asks the store which of them have changed, ten times a second and a part of them at a time; for sessions that
are decided here it seldom does. For a watcher that is behind, stored steps are read, a few at a time.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence

from specshield.arrays import Floats
from specshield.errors import LimitReached, NotFound, SessionDamaged, SpecshieldError
from specshield.service import metrics
from specshield.service.library.files import Recent
from specshield.service.schemas.answers import StepAnswer
from specshield.service.sessions import rules
from specshield.service.sessions.record import StepRecord
from specshield.service.sessions.session import Session, there
from specshield.service.sessions.state import State
from specshield.service.storage.archiving import ArchivingStore
from specshield.service.storage.store import Dump, News, shown
from specshield.service.watch.feed import KEPT, Feed, Told, begun, ruled

# All chosen by hand.
EVERY = 0.1  # [s] between two looks at a session: a page need not be quicker
SELDOM = 10  # only each tenth look includes sessions that are decided here, to notice their ends and switches
MOMENT, GIVE_WAY = 0.003, 30  # [s] about a decision, and the most of such waits: nobody sees 0.1 s
HERE = 3.0  # [s] since the last decision here for which a session counts as decided here
TOGETHER, EACH = 0.1, 0.0125  # [s] between two messages of a stream of several sessions, and in addition for
# each session: 0.5 s for 32. A message takes some 0.1 ms.
PARTS = 4  # in which the sessions are looked at, so that no look delays a decision for long
ARCHIVED = 64 << 20  # [bytes] of archived sessions that are kept for the streams that are behind
OLDER = 16  # times KEPT older steps that are kept for the streams that need the same ones: about 10 MB
AWAY = 3.0  # [s] between two looks whether an archived session still exists
HEARTBEAT = 15.0  # [s] without an event after which a comment is sent: less than proxies wait
FIRST = b"retry: 1000\n\n"
log = logging.getLogger("specshield")


class Watchers:
    """limit: the most open streams of this process. stopping: whether the server was told to stop. deciding:
    the number of steps that are being decided here.
    """

    def __init__(
        self, store: ArchivingStore, limit: int, stopping: Callable[[], bool], deciding: Callable[[], int]
    ) -> None:
        self._store, self._limit, self._stopping, self._deciding = store, limit, stopping, deciding
        self._feeds: dict[str, Feed] = {}
        self._open = Counter[str]()  # streams by owner
        # Of the streams that are behind, one at a time reads and writes older steps: that takes some ms.
        self._reading = asyncio.Lock()
        self._older = Recent[tuple[list[Told], int]](OLDER)  # by feed and first step
        self._archived = Recent[Dump](ARCHIVED, _size)  # by feed, while it has watchers

    async def run(self) -> None:
        """Looks for news of the watched sessions until it is cancelled."""
        for number in itertools.count():
            feeds = list(self._feeds.values())
            parts = min(PARTS, len(feeds))
            if not parts:  # sleeps longer, since waking up makes the steps of this process slower
                await asyncio.sleep(EVERY)
            for part in range(parts):
                await asyncio.sleep(EVERY / parts)
                all = (number + part) % SELDOM == 0
                await self._idle()
                elsewhere = time.monotonic() - HERE
                try:
                    await self._look([feed for feed in feeds[part::parts] if all or feed.here < elsewhere])
                except SpecshieldError:
                    pass  # the store is away: the news are read when it is back
                except Exception:
                    log.exception("what is new in a session cannot be read")
            if self._stopping():
                for feed in feeds:
                    feed.wake()

    def decided(
        self,
        id: str,
        before: bytes,
        after: bytes,
        state: State,
        row: Floats,
        made: StepRecord,
        answered: StepAnswer,
    ) -> None:
        """Notes a step that this process has decided and stored (`steps.Tell`). If the watchers lack more
        than this step, or it follows a switch, it is read from the store later, with all that they lack.
        """
        feed = self._feeds.get(id)
        if feed is not None and feed.version == before and made.t >= feed.end > feed.rules[-1].begins:
            rule = rules.at(feed.rules, made.t)
            each = Told(shown(id), made.t, b"", rule, row[:3].tolist(), made, answered)
            feed.version, feed.here = after, time.monotonic()
            feed.add(state, [each], made.t + 1, made.t + 1)

    async def open(self, id: str, after: int | None, owner: str = "") -> AsyncIterator[bytes] | None:
        """The stream of the decisions after step `after`, by default after the last decided one. None if
        there will be none. Raises NotFound, LimitReached.
        """
        self._check_room(owner)
        feed = self._feeds.get(id) or await self._begin(id)
        t = feed.end if after is None else after + 1
        return None if feed.over and t >= feed.end else self._stream({feed: t}, owner, several=False)

    async def open_all(self, after: Mapping[str, int | None], owner: str = "") -> AsyncIterator[bytes]:
        """One stream of the decisions of several sessions, each after its own step. Sessions that do not
        exist, or cannot be read, are left out. Raises LimitReached.
        """
        self._check_room(owner)
        places = {}
        for id, t in after.items():
            with contextlib.suppress(NotFound, SessionDamaged):
                feed = self._feeds.get(id) or await self._begin(id)
                places[feed] = feed.end if t is None else t + 1
        return self._stream(places, owner, several=True)

    async def _idle(self) -> None:
        """Waits a little while steps are being decided here."""
        for _ in range(GIVE_WAY):
            if not self._deciding():
                return
            await asyncio.sleep(MOMENT)

    def _check_room(self, owner: str) -> None:
        """Raises LimitReached if there is no room for one more stream. The owner of an API key may have half
        of them, so that nobody keeps all others from watching.
        """
        own, whose = self._open[owner], f"this server has {self._limit}"
        if owner and own >= max(self._limit // 2, 1):
            whose = f"this key has {own}"
        elif self._open.total() < self._limit:
            return
        raise LimitReached(
            f"{whose} open streams of events", expected="room for one more: close one, or ask another server"
        )

    async def _stream(self, after: Mapping[Feed, int], owner: str, several: bool) -> AsyncIterator[bytes]:
        """Serves one session at once, and `several` sessions from time to time with all their events."""
        places = {self._feeds.setdefault(feed.id, feed): t for feed, t in after.items()}
        feeds, told_at = list(places), time.monotonic()
        with self._watching(feeds, owner):
            yield FIRST
            while places and not self._stopping():
                told, changed = [], feeds[0].changed
                behind = [(feed, t) for feed, t in places.items() if t < feed.end or feed.over]
                for feed, t in behind:
                    async with self._reading if t < feed.start else contextlib.nullcontext():
                        found, t = await self._since(feed, t)
                        told += [each.whole if several else each.event for each in found]
                    places[feed] = t
                    if feed.over and t >= feed.end:
                        told.append(feed.last(several))
                        del places[feed]
                if told or time.monotonic() - told_at > HEARTBEAT:
                    told_at = time.monotonic()
                    yield b"".join(told) or b": alive\n\n"
                if several:
                    await asyncio.sleep(TOGETHER + EACH * len(places))
                    await self._idle()
                elif not behind:
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(changed.wait(), HEARTBEAT)

    @contextlib.contextmanager
    def _watching(self, feeds: Sequence[Feed], owner: str) -> Iterator[None]:
        for feed in feeds:
            feed.watchers += 1
        self._open[owner] += 1
        metrics.watchers.inc()
        try:
            yield
        finally:
            metrics.watchers.dec()
            self._open[owner] -= 1
            for feed in feeds:
                feed.watchers -= 1
                if not feed.watchers and self._feeds.get(feed.id) is feed:
                    del self._feeds[feed.id]
                    self._archived.drop(feed)

    async def _begin(self, id: str) -> Feed:
        found = there(await self._store.load(id), id)
        session = Session.of(found)
        state = session.state
        return Feed(
            id, *ruled(session), found.version, state.next_t, state.next_t, state.finished, state.spec_status
        )

    async def _look(self, feeds: list[Feed]) -> None:
        if not feeds:
            return
        before = [(feed.version, feed.end) for feed in feeds]
        news = await self._store.news([(feed.id, feed.end, feed.width, KEPT) for feed in feeds])
        since = time.monotonic() - AWAY
        for feed, known, new in zip(feeds, before, news, strict=True):
            if (feed.version, feed.end) != known:  # a step was decided here meanwhile: next time
                continue
            if new is None:
                if feed.version is not None or feed.looked < since:
                    await self._left(feed)
            elif new.version != feed.version:
                await self._gone_on(feed, new)

    async def _gone_on(self, feed: Feed, new: News) -> None:
        if feed.version is None:  # it is back from the archive, or another session has its id
            if await self._switched(feed):
                feed.version = b""
            else:
                feed.close()
        elif feed.outdated(new) and await self._switched(feed):
            return
        elif begun(new.version) != begun(feed.version or new.version):
            feed.close()  # it was erased, and another session was begun with its id
        else:
            state, (found, end) = State.of(new.state), feed.events(feed.end, new)
            upto = feed.reached(end, new)
            feed.add(state, found, end, upto)
            if upto >= state.next_t:  # else the next look reads the rest
                feed.version = new.version

    async def _switched(self, feed: Feed) -> bool:
        """Reads the rules again; other news are for the next look. False if the session is gone."""
        found = await self._store.load(feed.id)
        return found is not None and feed.rule(Session.of(found))

    async def _left(self, feed: Feed) -> None:
        """The session is no longer in the store: it was erased, or lies in the archive."""
        known, file = feed.version, await self._store.file(feed.id)
        feed.looked = time.monotonic()
        read = file is not None and file == feed.file  # then nothing is new
        dump = None
        with contextlib.suppress(SessionDamaged):  # as if it was erased
            dump = None if read else await self._store.dump(feed.id)
        if feed.version != known:  # a step of this process has brought it back meanwhile
            return
        if not read and (dump is None or not feed.rule(Session.of(dump))):
            self._archived.drop(feed)
            feed.close()
        elif dump is not None:
            new = News(dump.state, dump.version, dump.rows[feed.end * feed.width :], dump.steps[feed.end :])
            state, (found, _) = State.of(dump.state), feed.events(feed.end, new)
            feed.add(state, found, state.next_t, state.next_t)
        feed.version, feed.file = None, file

    async def _since(self, feed: Feed, t: int) -> tuple[list[Told], int]:
        """Decisions from step t on, and the step that follows them. Older ones are read from the store.
        Raises SessionDamaged.
        """
        if t >= feed.start:
            return feed.since(t), max(t, feed.end)
        await self._idle()
        read = self._older.peek((feed, t))
        if read is not None and feed.version:  # else the session has left the store, or was erased
            return read
        (new,) = await self._store.news([(feed.id, t, feed.width, KEPT)])
        if new is None:
            dump = self._archived.peek(feed)
            if dump is None or len(dump.steps) <= t:  # it may have been away from the archive in between
                dump = await self._store.dump(feed.id)
                if dump is None or not feed.rule(Session.of(dump)):
                    return [], feed.end
                self._archived.put(feed, dump)
            rows = dump.rows[t * feed.width : (t + KEPT) * feed.width]
            new = News(dump.state, dump.version, rows, dump.steps[t : t + KEPT])
        elif feed.outdated(new):
            return [], t if await self._switched(feed) else feed.end
        found, end = feed.events(t, new)
        if len(new.steps) == KEPT:
            self._older.put((feed, t), (found, end))
        return found, end if end > t else feed.end


def _size(dump: Dump) -> int:
    """About the bytes of a session; at most ARCHIVED, so that one of any size is kept while it is read."""
    return min(len(dump.rows) + sum(map(len, dump.steps)), ARCHIVED)
