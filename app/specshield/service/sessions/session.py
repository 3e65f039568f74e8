"""A session as it was read from the store, and the checks of what a request may ask of it (pure)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec import structs

from specshield import episode
from specshield.arrays import Floats
from specshield.episode.handover import check_main_task
from specshield.errors import Conflict, InputError, NotFound, SessionFinished, StepConflict
from specshield.reasons.explanation import explanations
from specshield.robot import robot_from_json
from specshield.service.library import files
from specshield.service.schemas import robots
from specshield.service.schemas.answers import StepAnswer, to_json
from specshield.service.schemas.steps import StepBody
from specshield.service.sessions import history, record
from specshield.service.sessions import rules as ruled
from specshield.service.sessions.record import Asked, StepRecord
from specshield.service.sessions.rules import Rule
from specshield.service.sessions.state import State
from specshield.service.storage.store import Dump, Record, shown
from specshield.shield.decision import Carry, Config, Decision, Shield

F = TypeVar("F")
RACES = 10  # tries to write a change: another writer may come first each time
# Bytes of memory that a session takes beside its state and its rows: its objects, and for each byte of its
# rules' JSON their parsed form. tracemalloc found 3,000, and 5 to 10, with rules of 1 to 200 kB.
OBJECTS, PARSED = 3_000, 10


class Session(NamedTuple):
    """A session as one read saw it. rows [length, 3 + signals]: x, y, theta and the samples of the signals.

    rules: those so far; the last one is in force. settings: those of the last one. signal_names: by column.
    weight, held: bytes of the rules and of the state in the store.
    """

    rules: Sequence[Rule]
    settings: Config
    state: State
    version: bytes
    rows: Floats
    signal_names: list[str]
    weight: int
    held: int

    @staticmethod
    def of(stored: Record | Dump) -> Session:
        rules, state = ruled.read(stored.config), State.of(stored.state)
        names = ruled.columns(rules)[-1]
        width = 3 + len(names)
        rows = np.frombuffer(stored.rows, "<f8", state.length * width).reshape(-1, width)
        sizes = len(stored.config), len(stored.state)
        return Session(rules, rules[-1].settings, state, stored.version, rows, names, *sizes)

    @property
    def size(self) -> int:
        """About how many bytes of memory the session takes."""
        return OBJECTS + PARSED * self.weight + self.held + self.rows.nbytes

    @property
    def rule(self) -> Rule:
        """The rule that is in force."""
        return self.rules[-1]

    @property
    def id(self) -> str:
        return self.rule.id

    @property
    def poses(self) -> Floats:
        return self.rows[:, :3]

    @property
    def since(self) -> Floats:
        """The rows from the origin of the rule in force on, which are its history."""
        return self.rows[self.rule.origin :]

    def extended(self, t: int, poses: Floats, signals: Mapping[str, float]) -> Session:
        """The session with its history up to t; signals that are not sent hold their last value."""
        added = history.join(self.poses, t, poses)
        known, width = self.rows.shape
        rows = np.empty((known + len(added), width))
        rows[:known], rows[known:, :3] = self.rows, added
        rows[known:, 3:] = self.rows[-1, 3:]
        for name, value in signals.items():
            rows[t, 3 + self.signal_names.index(name)] = value
        return self._replace(rows=rows)

    def added(self, stored: int) -> tuple[bytes, int]:
        """The rows that a change has to write, and the byte where they begin: the new rows, or row 0 once
        more with the first step, which brings its signals. stored: the number of rows in the store.
        """
        first = min(stored, len(self.rows) - 1)
        return pack(self.rows[first:]), first * 8 * self.rows.shape[1]

    def check_step(self, request: StepBody) -> None:
        """Raises what keeps a step that was not decided before from being decided now."""
        self.check_ahead(request.t, f"step {request.t} was passed over and can no longer be decided")
        check_last(request.t, self.rule.max_steps)
        check_main_task(self.state.main_task_done, request.main_task_done)

    def check_ahead(self, t: int, otherwise: str) -> None:
        """Raises SessionFinished, or StepConflict saying `otherwise`, unless t can follow those decided."""
        if self.state.finished:
            raise self.over(t)
        ahead = self.state.next_t
        if t < ahead:
            raise StepConflict(otherwise, path="t", got=t, expected=f"{ahead} or later", expected_t=ahead)

    def over(self, t: int) -> SessionFinished:
        """The error for a step that is asked for after the session's end."""
        told = f"session {self.id!r} is over: no further step is decided"
        expected = "a new session; or a step that was decided, to read its answer again"
        return SessionFinished(told, path="t", got=t, expected=expected)

    def replay(self, step: bytes, request: StepBody) -> StepAnswer:
        """The stored answer. Raises StepConflict where it answered another request."""
        kept, row = record.decode(step), self.rows[request.t]
        asked, before = asked_of(request), kept.asked(row, self.signal_names)
        same = {
            "pose": asked.pose == before.pose,
            "signals": asked.signals == before.signals,
            "main_task_done": asked.main_task_done == before.main_task_done,
            "logits": _equal(asked.logits, before.logits),
            "occupied": _equal(asked.occupied, before.occupied),
            "free": _equal(asked.free, before.free),
        }
        if not all(same.values()):
            t, ahead = request.t, self.state.next_t
            other = ", ".join(name for name, equal in same.items() if not equal)
            told = f"step {t} was decided already, with other values of: {other}"
            expected = f"the same request again, or step {ahead}; a session is for one robot alone"
            raise StepConflict(told, path="t", got=t, expected=expected, expected_t=ahead)
        history.join(self.poses, request.t, np.array(request.poses))
        return record.answer(kept, row, self.rules[ruled.at(self.rules, request.t)].actions)

    def learned(self) -> bytes:
        """The cells in which the session's own map differs from the map, as JSON."""
        known = self.state.learned
        about = {"t": self.state.next_t - 1, "map_id": self.rule.map_id, "map_revision": known.revision}
        occupied, free = (known.cell[known.occupied == held].tolist() for held in (True, False))
        return files.to_json({**about, "occupied": occupied, "free": free})

    def lines(self, steps: Sequence[bytes], after: int) -> Iterator[bytes]:
        """One JSON object for each step after step `after`: t, pose, signals, index of the rule, the logits
        sent, the answer.
        """
        for t in range(after + 1, len(self.rows)):
            row = self.rows[t]
            held, index = row.tolist(), ruled.at(self.rules, t)
            rule, values = self.rules[index], dict(zip(self.signal_names, held[3:], strict=True))
            signals = {name: values[name] for name in sorted(rule.spec["signals"])}
            head = msgspec.json.encode({"t": t, "pose": held[:3], "signals": signals, "rule": index})
            step = steps[t] if t < len(steps) else b""
            kept = record.decode(step) if step else None
            logits = msgspec.json.encode(None if kept is None else record.logits_json(kept))
            told = b"null" if kept is None else to_json(record.answer(kept, row, rule.actions))
            yield head[:-1] + b',"logits":' + logits + b',"decision":' + told + b"}"


# The members of a rule that the contract does not show, or shows in another form.
INSIDE = ("robot", "nonce", "owner", "begins", "origin", "clock", "before", "way", "version")


def describe(rules: Sequence[Rule], state: State) -> dict[str, Any]:
    """The session as the contract shows it."""
    shown = {name: value for name, value in structs.asdict(rules[-1]).items() if name not in INSIDE}
    names = ("next_t", "feasible", "any_signal", "spec_status", "main_task_done", "finished")
    return {
        **shown,
        "robot": robots.describe(robot_from_json(rules[-1].robot)),
        **{name: getattr(state, name) for name in names},
        "expires_at": files.rfc3339(state.expires_at),
        "rules": ruled.told(rules, [*state.verdicts, state.spec_status]),
    }


def needed(rules: Sequence[Rule], state: State) -> set[str]:
    """The policies that the session still needs: those of the rule in force, and those of earlier rules whose
    verdicts are still open, since their maps are needed for these.
    """
    waiting = [a for a, b in pairwise(rules) if b.begins >= state.next_t]
    return {id for rule in [*waiting, rules[-1]] for id in rule.policy_ids}


def check_last(t: int, last: int) -> None:
    """Raises InputError for a step after `last`, the session's last one."""
    if t > last:
        raise InputError(f"step {t} is past max_steps", path="t", got=t, expected=f"at most {last}")


def asked_of(request: StepBody) -> Asked:
    logits = request.logits
    return Asked(
        request.poses[-1],
        None if logits is None else np.array([-np.inf if z is None else z for z in logits], np.float64),
        request.main_task_done,
        request.signals or {},
        request.witnesses,
        _points(request.occupied),
        _points(request.free),
        request.explain,
    )


def _points(sent: Sequence[Sequence[float]] | None) -> Floats | None:
    return None if sent is None else np.array(sent, np.float64).reshape(-1, 2)


def _equal(a: Floats | None, b: Floats | None) -> bool:
    return a is b if a is None or b is None else np.array_equal(a, b)


def decide(
    shield: Shield,
    asked: Asked,
    t: int,
    since: Floats,
    names: Sequence[str],
    carry: Carry | None,
    before: bytes,
    tables: bytes | None,
) -> tuple[Decision, StepRecord]:
    """The decision of step t, and its record. since: the rows from the rule's origin to x_t; names: of their
    signals, by column. carry: of the decision before. before, tables: members of the record.
    """
    decision = episode.decide(
        shield,
        since[:, :3],
        asked.logits,
        asked.main_task_done,
        ruled.signals_in(since, names),
        carry,
        asked.all_witnesses,
        asked.occupied,
        asked.free,
        explanations if asked.explain else None,
    )
    if decision.t != t:  # the core counts from the rule's origin
        decision = decision._replace(t=t)
    return decision, record.make(decision, asked, since[-1], names, before, tables)


def pack(rows: Floats) -> bytes:
    return np.ascontiguousarray(rows, "<f8").tobytes()


def there(found: F | None, key: str) -> F:
    """`found`, what the store has of a session. Raises NotFound where that is None."""
    if found is None:
        raise missing(key)
    return found


def missing(key: str) -> NotFound:
    id = shown(key)
    told = f"there is no session {id!r}; it may have expired"
    return NotFound(told, path="id", got=id, expected="an id from /v1/sessions")


def contended(key: str) -> Conflict:
    id = shown(key)
    told = f"several callers write to session {id!r} at once"
    return Conflict(told, path="id", got=id, expected="one caller for each session")
