"""The latest decisions of one watched session, and how they are written as events."""

from __future__ import annotations

import asyncio
import json
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import msgspec
import numpy as np

from specshield.service.schemas.answers import StepAnswer, to_json
from specshield.service.sessions import record, rules
from specshield.service.sessions.record import StepRecord
from specshield.service.sessions.rules import Rule
from specshield.service.sessions.session import Session, describe
from specshield.service.sessions.state import State
from specshield.service.storage.archive import Entry
from specshield.service.storage.store import News, shown

KEPT = 64  # events that are kept for the watchers of a session, and the most that are read at once


@dataclass(frozen=True)
class Told:
    """A decision for watchers. session: its id. switch: events that come before it. rule: the index of the
    session's rule. pose: x_t. made: the record of the step. answered: its answer.

    The events are written when they are needed, once for all watchers.
    """

    session: str
    t: int
    switch: bytes
    rule: int
    pose: Sequence[float]
    made: StepRecord
    answered: StepAnswer

    @cached_property
    def answer(self) -> bytes:
        return to_json(self.answered)

    @cached_property
    def event(self) -> bytes:
        return b"%sid: %d\ndata: %s\n\n" % (self.switch, self.t, self.answer)

    @cached_property
    def whole(self) -> bytes:
        """The event in a stream of several sessions."""
        asked = {"session": self.session, "t": self.t, "pose": self.pose, "rule": self.rule}
        head = msgspec.json.encode({**asked, "logits": record.logits_json(self.made)})[:-1]
        return b'data: %s,"decision":%s}\n\n' % (head, self.answer)


@dataclass(eq=False)
class Feed:
    """A watched session. rules: all rules so far; told: the same as the contract shows them. width: bytes of
    a row.

    recent: the decisions of the steps from `start` to before `end`. version: the last one that was read; None
    if the session is not in the store, b"" if it has come back and was not read yet. looked: when it was last
    looked for in the archive; here: when this process last decided a step of it [s of time.monotonic]. file:
    the file of the archive that was read last.
    """

    id: str
    rules: Sequence[Rule]
    told: list[dict[str, Any]]
    width: int
    version: bytes | None
    start: int
    end: int
    over: bool
    status: str
    watchers: int = 0
    here: float = -math.inf
    looked: float = -math.inf
    file: Entry | None = None
    recent: deque[Told] = field(default_factory=lambda: deque(maxlen=KEPT))
    changed: asyncio.Event = field(default_factory=asyncio.Event)

    def add(self, state: State, found: Sequence[Told], end: int, reached: int) -> None:
        """Adds decisions. end: the step after those that were read. reached: the same, but after steps that a
        switch has passed over.
        """
        for each in found:
            if len(self.recent) == KEPT:
                self.start = self.recent[0].t + 1
            self.recent.append(each)
        self.over, self.status = state.finished and reached >= state.next_t, state.spec_status
        self.end = reached if self.over else end  # a switch of which no event has told is at `end` or later
        self.wake()

    def since(self, t: int) -> list[Told]:
        """The kept decisions from step t on."""
        found = []
        for each in reversed(self.recent):
            if each.t < t:
                break
            found.append(each)
        return found[::-1]

    def rule(self, session: Session) -> bool:
        """Takes over the session's rules. False if this is another session with the same id."""
        rules, told, width = ruled(session)
        if rules[0].nonce != self.rules[0].nonce:
            return False
        self.rules, self.told, self.width = rules, told, width
        return True

    def close(self) -> None:
        """Ends the feed of a session that was erased."""
        self.over = True
        self.wake()

    def wake(self) -> None:
        self.changed.set()
        self.changed = asyncio.Event()

    def events(self, t: int, new: News) -> tuple[list[Told], int]:
        """The decisions in `new`, whose steps begin with t, and the step that follows them. The first
        decision after a switch has the event of the switch.
        """
        found = []
        switched = [rule for rule in self.told[1:] if rule["from"] >= t]
        for i, step in enumerate(new.steps):
            if step:
                row = np.frombuffer(new.rows[i * self.width : (i + 1) * self.width], "<f8")
                rule = rules.at(self.rules, t + i)
                kept = record.decode(step)
                answer = record.answer(kept, row, self.rules[rule].actions)
                switch = b""
                while switched and switched[0]["from"] <= t + i:
                    switch += b"event: switch\ndata: %s\n\n" % json.dumps(switched.pop(0)).encode()
                found.append(Told(shown(self.id), t + i, switch, rule, row[:3].tolist(), kept, answer))
        return found, t + len(new.steps)

    def reached(self, end: int, new: News) -> int:
        """The step that follows those in `new`, which end before `end`, and those that the last switch passed
        over: the list has these only once a later step is decided. The state cannot show that, since it may
        be newer than the steps.
        """
        return end if len(new.steps) == KEPT else max(end, self.rules[-1].begins)

    def outdated(self, new: News) -> bool:
        """Whether the session has had a switch that this feed does not know; its rows may be wider now."""
        return len(State.of(new.state).verdicts) >= len(self.rules)

    def last(self, several: bool) -> bytes:
        """The last event. In a stream of several sessions it names the session that has ended."""
        told = {"next_t": self.end, "spec_status": self.status, "finished": True}
        if several:
            return b"data: %s\n\n" % json.dumps({"session": shown(self.id), **told}).encode()
        return b"event: end\ndata: %s\n\n" % json.dumps(told).encode()


def ruled(session: Session) -> tuple[Sequence[Rule], list[dict[str, Any]], int]:
    """The members `rules`, `told` and `width` of a `Feed`."""
    told = describe(session.rules, session.state)["rules"]
    return session.rules, told, 8 * session.rows.shape[1]


def begun(version: bytes) -> bytes:
    """The part of a version that differs between two sessions with the same id."""
    return version.partition(b":")[0]
