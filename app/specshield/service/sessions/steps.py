"""Decides steps: reads the session, makes the decision, and writes poses, record and state, or nothing."""

from __future__ import annotations

import asyncio
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np

from specshield.arrays import Floats
from specshield.caution.taught import teach
from specshield.episode.handover import check_signals
from specshield.errors import SpecshieldError
from specshield.service import metrics
from specshield.service.heavy.heavy import Heavy
from specshield.service.heavy.pool import Turns
from specshield.service.library import files
from specshield.service.schemas.answers import StepAnswer
from specshield.service.schemas.steps import StepBody
from specshield.service.sessions import record
from specshield.service.sessions.record import StepRecord
from specshield.service.sessions.rules import Rule
from specshield.service.sessions.session import RACES, Session, asked_of, contended, decide, missing
from specshield.service.sessions.shields import Shields
from specshield.service.sessions.state import State
from specshield.service.storage.store import Change, Store
from specshield.shield.decision import Decision

T = TypeVar("T")
ROOM = 64 << 20  # [bytes] of sessions kept in memory: some 4,000. Chosen by hand.
WATCHED = 32  # decisions that are made in threads after a long one. Chosen by hand.
SHORT = 0.005  # [s] that one decision may hold the event loop
LONG = 0.03  # [s] of a processor; decisions that take longer are made in another process
LONG_BODY = 64 << 10  # [bytes] of a step that is read in turn
MANY = 1000  # poses in a step that is decided in turn. With 10,000 each takes some ms of the event loop.
WAITING = 256  # such steps of one owner that wait
MOMENT, GIVE_WAY = 0.003, 8  # [s] about a decision, and the most of such waits; all five chosen by hand
SEVERAL = 4  # decisions; one or two may be long because kernels are loaded
# The session's key, its version before and after, its state, x_t with the signals, the record and the answer.
Tell = Callable[[str, bytes, bytes, State, Floats, StepRecord, StepAnswer], None]


class Decided(NamedTuple):
    """A step decided on `session`, before it is written."""

    session: Session
    decision: Decision
    record: StepRecord


class Pace:
    """How long decisions with some policies take, which says where the next one is made.

    Most decisions are made on the event loop: handing one to a thread and back takes about as long as the
    decision. The first few are made in threads. On the event loop only the elapsed time is measured. Where
    two decisions close together took longer than SHORT, the decisions may be long or the machine busy: so the
    processor's time is measured for the next few. After one that computed for longer than SHORT, the next
    WATCHED are made in threads; after several longer than LONG, all are made in another process.
    """

    def __init__(self) -> None:
        self._threaded = SEVERAL  # decisions that are still to be made in threads
        self.doubted = 0  # decisions on the event loop whose processor time is still to be measured
        self._since_late = WATCHED  # decisions on the event loop since one that took longer than SHORT
        self._long = 0  # decisions that computed for longer than LONG

    @property
    def short(self) -> bool:
        return self._threaded == 0

    @property
    def long(self) -> bool:
        return self._long >= SEVERAL

    def add(self, seconds: float, computed: float | None) -> None:
        """Notes a decision. computed: its seconds of a processor, None if they were not measured."""
        if computed is None:
            late = seconds > SHORT
            self.doubted = SEVERAL if late and self._since_late < SEVERAL else 0
            self._since_late = 0 if late else self._since_late + 1
            return
        self.doubted = max(self.doubted - 1, 0)
        self._threaded = WATCHED if computed > SHORT else max(self._threaded - 1, 0)
        self._long += computed > LONG


class Steps:
    """Decides steps on the event loop, in threads (rollouts release the interpreter) or in other processes:
    see `Pace`. ttl: how long a session is kept after its last change [s]. tell: called for each stored step.
    """

    def __init__(
        self, store: Store, shields: Shields, threads: ThreadPoolExecutor, heavy: Heavy, ttl: int, tell: Tell
    ) -> None:
        self._store, self._shields, self._threads, self._ttl = store, shields, threads, ttl
        self._heavy, self._tell = heavy, tell
        self.deciding = 0  # steps that are being decided
        self._turns = Turns(1, WAITING)
        self.long_requests = Turns(1, WAITING)  # with a long history that are no steps, and may last long
        # A kept session may be out of date, since other processes write too: the append then finds that out.
        self.recent = files.Recent[Session](ROOM, attrgetter("size"))
        self._paces = files.Recent[Pace](1000)

    async def decide(self, id: str, request: StepBody, timing: defaultdict[str, float]) -> StepAnswer:
        """The answer. `timing` collects the seconds of rollout and store."""
        self.deciding += 1
        try:
            if self.deciding > 1:  # what came together is all read before any is decided: fewer misses
                await asyncio.sleep(0)
            return await self._answer(id, request, timing)
        finally:
            self.deciding -= 1

    async def _answer(self, id: str, request: StepBody, timing: defaultdict[str, float]) -> StepAnswer:
        session, step = self.recent.peek(id), None
        if session is not None and request.t < session.state.next_t:
            session = None  # a replay or an error: for both the store has to be asked
        current = False  # whether the session was read from the store just now
        for _ in range(RACES):
            if session is None:
                asked = time.perf_counter()
                found = await self._store.load(id, request.t)
                timing["store"] += time.perf_counter() - asked
                if found is None:
                    raise missing(id)
                session, step, current = Session.of(found), found.step, True
            if step is not None:
                metrics.replayed()
                return session.replay(step, request)
            try:
                session.check_step(request)
                decided = await self._decide(session, request, timing)
            except SpecshieldError:
                if current:
                    raise
                session = None
                continue
            change, state = self._change(decided, request)
            asked = time.perf_counter()
            written = await self._store.append(id, session.version, change)
            timing["store"] += time.perf_counter() - asked
            if isinstance(written, bytes):
                told_later = len(decided.session.rows) - 1 - session.state.length
                answer = record.told(decided.decision, request.witnesses, request.explain)
                row = decided.session.rows[-1]
                self._tell(id, session.version, written, state, row, decided.record, answer)
                if state.finished:  # no further step will need it
                    self.recent.drop(id)
                else:
                    held = len(change.state)
                    self.recent.put(id, decided.session._replace(state=state, version=written, held=held))
                metrics.decided(decided.decision, told_later, timing)
                return answer
            self.recent.drop(id)
            if written is None:
                raise missing(id)
            session, step, current = Session.of(written), written.step, True
        raise contended(id)

    def _change(self, decided: Decided, request: StepBody) -> tuple[Change, State]:
        session, decision, content = decided.session, decided.decision, record.encode(decided.record)
        state = msgspec.structs.replace(
            session.state,
            length=len(session.rows),
            next_t=len(session.rows),
            spec_status=decision.spec_status,
            expires_at=time.time() + self._ttl,
            head=record.digest(content),
            main_task_done=request.main_task_done,
            finished=decision.finished,
            carry=decision.carry,
        )
        return Change(state.packed(), *session.added(session.state.length), request.t, content), state

    async def _decide(self, session: Session, request: StepBody, timing: defaultdict[str, float]) -> Decided:
        ids = tuple(session.rule.policy_ids)
        pace = self._paces.get(alike(session.rule, request), Pace)
        if self._shields.slow(session, pace.long):
            asked = timed, session, request
            made, seconds, _ = await self._heavy.decide(*asked, session=session.id, key=ids)
            timing["rollout"] += seconds
            return made
        if len(request.poses) <= MANY:
            return await self._decide_here(session, request, pace, timing)
        self.deciding -= 1
        try:
            given = session, request, pace, timing
            return await self.giving_way(session.rule.owner, self._decide_here, *given)
        finally:
            self.deciding += 1

    async def giving_way(self, owner: str, call: Callable[..., Awaitable[T]], /, *args: Any) -> T:
        """The result of a call that takes some ms of the event loop, as for a step with a long history. Such
        calls are made one at a time, and wait a little while other steps are being decided.
        """
        await self._turns.take(owner)
        try:
            for _ in range(GIVE_WAY):
                if not self.deciding:
                    break
                await asyncio.sleep(MOMENT)
            return await call(*args)
        finally:
            self._turns.give()

    async def _decide_here(
        self, session: Session, request: StepBody, pace: Pace, timing: defaultdict[str, float]
    ) -> Decided:
        cpu: float | None = None
        # A step may take long once the map is no longer the one that the policies were made for. The first
        # ones may have to read the policies, so `learns`, which needs them too, is not asked before these.
        if not pace.short or learns(self._shields, session, request):
            run = asyncio.get_running_loop().run_in_executor
            made, seconds, cpu = await run(self._threads, timed, self._shields, session, request)
        elif pace.doubted:
            made, seconds, cpu = timed(self._shields, session, request)
        else:  # measuring the thread's own time would cost a tenth of the step
            begun = time.perf_counter()
            made = decided(self._shields, session, request)
            seconds = time.perf_counter() - begun
        timing["rollout"] += seconds
        # The time on a changed map, or with a long history, says nothing of others with these policies.
        if not (request.occupied or request.free or made.decision.map_revision or len(request.poses) > MANY):
            pace.add(seconds, cpu)
        return made


def alike(rule: Rule, request: StepBody) -> tuple[str | bool, ...]:
    """What decisions have in common of which one tells how long another takes. The owner, since another
    owner's robots may be on the map as it is, where decisions are short. Whether it is explained, since an
    explanation may take a hundred times as long as the decision.
    """
    return rule.owner, rule.shaping, request.explain, *rule.policy_ids


def learns(shields: Shields, session: Session, request: StepBody) -> bool:
    """Whether the session's own map will differ from its policies' map at this step. A robot that arrived
    just where its action leads has met nothing, which is seen at once.
    """
    if request.occupied or request.free or session.state.has_learned:
        return True
    shield, carry = shields.of(session), session.state.carry
    if not shield.config.learn_map or carry is None or carry.action is None:
        return False
    motion = shield.task.robot.motion_of[carry.action]
    if motion >= 0 and carry.next_poses[motion].tolist() == request.poses[-1]:
        return False
    here = session.extended(request.t, np.array(request.poses, np.float64), {}).since[:, :3]
    return teach(shield, carry, here, None, None)[0].map.revision > 0


def timed(shields: Shields, session: Session, request: StepBody) -> tuple[Decided, float, float]:
    """As `decided`, and the seconds that it took: elapsed, and of this thread's computing."""
    begun, computed = time.perf_counter(), time.thread_time()
    made = decided(shields, session, request)
    return made, time.perf_counter() - begun, time.thread_time() - computed


def decided(shields: Shields, session: Session, request: StepBody) -> Decided:
    shield, asked, names, state = shields.of(session), asked_of(request), session.signal_names, session.state
    check_signals(names, asked.signals)
    session = shields.settled(session.extended(request.t, np.array(request.poses, np.float64), asked.signals))
    shield, tables = shields.tables.of(session.rule.nonce, shield, state.learned, session.rule.owner)
    before, since = record.link(state.head, session.rows[state.next_t :]), session.since
    return Decided(session, *decide(shield, asked, request.t, since, names, state.carry, before, tables))
