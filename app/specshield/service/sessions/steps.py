"""Deciding steps: the session is read, the step decided and both written, all of it or nothing."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import msgspec
import numpy as np

from specshield.service import metrics
from specshield.service.heavy.heavy import Heavy
from specshield.service.schemas.answers import StepAnswer
from specshield.service.schemas.steps import StepRequest
from specshield.service.sessions import record
from specshield.service.sessions.record import StepRecord
from specshield.service.sessions.session import (
    RACES,
    Session,
    check_step,
    contended,
    logits_of,
    missing,
    replay,
)
from specshield.service.sessions.shields import Shields
from specshield.service.sessions.state import pack_carry
from specshield.service.storage.store import Change, Store
from specshield.shield import episode
from specshield.shield.decision import Decision

LONG = 0.03  # [s] of a processor for one decision, from which on a session's are made in other processes


class Steps:
    """Decisions run in threads (the rollouts release the interpreter), long ones in other processes.

    ttl: how long a session is kept after its last change [s].
    """

    def __init__(
        self, store: Store, shields: Shields, threads: ThreadPoolExecutor, heavy: Heavy, ttl: int
    ) -> None:
        self._store, self._shields, self._threads, self._ttl = store, shields, threads, ttl
        self._heavy = heavy

    async def decide(self, id: str, request: StepRequest, timing: dict[str, float]) -> StepAnswer:
        """The answer. `timing` collects the seconds of rollout and store."""
        for _ in range(RACES):
            with _clock(timing, "store"):
                found = await self._store.load(id, request.t)
            if found is None:
                raise missing(id)
            session = Session.of(found)
            if found.step is not None:
                metrics.replayed()
                return replay(session, found.step, request)
            check_step(session, request)
            session, decision, made = await self._decided(session, request, timing)
            content = record.encode(made)
            state = msgspec.structs.replace(
                session.state,
                length=len(session.rows),
                next_t=len(session.rows),
                spec_status=decision.spec_status,
                expires_at=time.time() + self._ttl,
                head=record.digest(content),
                main_task_done=request.main_task_done,
                finished=decision.finished,
                carry=pack_carry(decision.carry),
            )
            change = Change(state.packed(), *session.added(), request.t, content)
            with _clock(timing, "store"):
                kept = isinstance(await self._store.append(id, session.version, change), bytes)
            if kept:
                metrics.decided(decision, len(session.rows) - 1 - session.state.length, timing)
                return record.answer(made, session.rows[-1], session.config["actions"])
        raise contended(id)

    async def _decided(
        self, session: Session, request: StepRequest, timing: dict[str, float]
    ) -> tuple[Session, Decision, StepRecord]:
        """In a thread, or in another process where such decisions take long."""
        key = tuple(session.config["policy_ids"])
        if self._shields.slow(session):
            *made, seconds = await self._heavy.decide("step", session, request, session=session.id, key=key)
            timing["rollout"] = timing.get("rollout", 0.0) + seconds
            return made[0], made[1], made[2]
        loop = asyncio.get_running_loop()
        session, decision, record, seconds, cpu = await loop.run_in_executor(
            self._threads, timed, self._shields, session, request
        )
        timing["rollout"] = timing.get("rollout", 0.0) + seconds
        if cpu > LONG:
            self._shields.note_slow(session)
        return session, decision, record


def timed(
    shields: Shields, session: Session, request: StepRequest
) -> tuple[Session, Decision, StepRecord, float, float]:
    """As `decided`, with the seconds that it took, and those of them that this thread computed."""
    begun, computed = time.perf_counter(), time.thread_time()
    made = decided(shields, session, request)
    return *made, time.perf_counter() - begun, time.thread_time() - computed


def decided(shields: Shields, session: Session, request: StepRequest) -> tuple[Session, Decision, StepRecord]:
    shield, signals = shields.of(session), request.signals or {}
    shield.task.check_signals(signals)
    state, logits = session.state, logits_of(request)
    session = session.extended(request.t, np.array(request.poses, np.float64), signals)
    carry = None if state.carry is None else state.carry.unpacked()
    decision = episode.decide(
        shield, session.poses, logits, request.main_task_done, session.signals, carry, request.witnesses
    )
    made = record.make(
        decision,
        session.rows[-1],
        record.link(state.head, session.rows[state.next_t :]),
        request.poses[-1],
        logits,
        request.main_task_done,
        signals,
        session.signal_names,
        request.witnesses,
    )
    return session, decision, made


@contextmanager
def _clock(timing: dict[str, float], name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    timing[name] = timing.get(name, 0.0) + time.perf_counter() - start
