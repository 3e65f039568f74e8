"""A session as it is stored, and what a request may ask of it (pure)."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from specshield.arrays import Floats
from specshield.errors import InputError, SessionFinished, StepConflict
from specshield.service.library import files
from specshield.service.schemas.steps import StepRequest
from specshield.service.sessions import history
from specshield.service.storage.store import Record
from specshield.shield.decision import Decision

DIGEST = 32  # bytes that stand before each stored answer: of the request that it answers


@dataclass(frozen=True)
class State:
    """What changes in a session. length: of the stored poses. next_t: the step after the last decided one."""

    length: int
    next_t: int
    feasible: bool
    spec_status: str
    expires_at: float
    main_task_done: bool = False
    finished: bool = False
    closed: bool = False
    carry: Any = None


@dataclass(frozen=True)
class Session:
    """A session as one read saw it. rows [length, 3 + signals]: x, y, theta and the signals held."""

    config: dict[str, Any]
    state: State
    version: bytes
    rows: Floats
    step: bytes | None

    @staticmethod
    def of(record: Record) -> Session:
        config, state = json.loads(record.config), State(**json.loads(record.state))
        rows = np.frombuffer(record.rows, "<f8").reshape(-1, 3 + len(config["spec"]["signals"]))[
            : state.length
        ]
        return Session(config, state, record.version, rows, record.step)

    @property
    def id(self) -> str:
        return str(self.config["id"])

    @property
    def poses(self) -> Floats:
        return self.rows[:, :3]

    @property
    def signal_names(self) -> list[str]:
        return sorted(self.config["spec"]["signals"])

    def extended(self, t: int, poses: Floats, signals: Mapping[str, float]) -> Session:
        """The session with its history up to t; signals that are not sent hold their last value."""
        added = history.join(self.poses, t, poses)
        rows = np.vstack([self.rows, np.hstack([added, np.repeat(self.rows[-1:, 3:], len(added), axis=0)])])
        for name, value in signals.items():
            rows[t, 3 + self.signal_names.index(name)] = value
        return replace(self, rows=rows)

    @property
    def signals(self) -> dict[str, Floats]:
        return columns(self.rows, self.signal_names)


def describe(config: Mapping[str, Any], state: State) -> dict[str, Any]:
    """The session as the contract shows it."""
    shown = {name: value for name, value in config.items() if name not in ("robot", "nonce")}
    names = ("next_t", "feasible", "spec_status", "main_task_done", "finished")
    return {
        **shown,
        **{name: getattr(state, name) for name in names},
        "expires_at": files.rfc3339(state.expires_at),
    }


def check_step(session: Session, request: StepRequest) -> None:
    """Raises what is wrong with asking for a step that was not decided before."""
    state, t, last = session.state, request.t, session.config["max_steps"]
    if state.finished:
        raise over(session, t)
    if t > last:
        raise InputError(
            f"step {t} is past the session's max_steps", path="t", got=t, expected=f"at most {last}"
        )
    if t < state.next_t:
        raise StepConflict(
            f"step {t} was passed over and can no longer be decided",
            path="t",
            got=t,
            expected=f"{state.next_t} or later",
            expected_t=state.next_t,
        )
    if state.main_task_done and not request.main_task_done:
        raise StepConflict(
            "an earlier step said that the main task is done, which cannot be taken back",
            path="main_task_done",
            got=False,
            expected="true",
        )


def replay(session: Session, request: StepRequest, digest: bytes) -> bytes:
    """The stored answer. Raises StepConflict where it answered another request."""
    assert session.step is not None
    if session.step[:DIGEST] != digest:
        raise StepConflict(
            f"step {request.t} was decided for another x_t, logits, signals or main_task_done",
            path="t",
            got=request.t,
            expected=f"the same request again, or step {session.state.next_t}",
            expected_t=session.state.next_t,
        )
    history.join(session.poses, request.t, np.array(request.poses))
    return session.step[DIGEST:]


def digest_of(request: StepRequest) -> bytes:
    """The digest of what makes two requests the same: x_t, logits, main_task_done and signals, as float64."""
    logits = None if request.logits is None else [-math.inf if v is None else v + 0.0 for v in request.logits]
    signals = sorted((request.signals or {}).items())
    content = repr([[float(v) + 0.0 for v in request.poses[-1]], logits, request.main_task_done, signals])
    return hashlib.sha256(content.encode()).digest()


def encode(decision: Decision, witnesses: bool) -> bytes:
    residual = decision.residual
    answer = {
        field.name: getattr(decision, field.name) for field in fields(decision) if field.name != "carry"
    }
    answer |= {
        "distribution": decision.distribution.tolist(),
        "next_poses": decision.next_poses.tolist(),
        "residual": None if residual is None else {"translation": residual[0], "rotation": residual[1]},
    }
    if not witnesses:
        del answer["witnesses"]
    return files.to_json(answer)


def lines(session: Session, steps: Mapping[int, bytes]) -> Iterator[bytes]:
    for t, row in enumerate(session.rows.tolist()):
        head = files.to_json(
            {"t": t, "pose": row[:3], "signals": dict(zip(session.signal_names, row[3:], strict=True))}
        )
        yield head[:-1] + b',"decision":' + (steps[t][DIGEST:] if t in steps else b"null") + b"}"


def columns(rows: Floats, names: Iterable[str]) -> dict[str, Floats]:
    return {name: rows[:, 3 + i] for i, name in enumerate(names)}


def pack(rows: Floats) -> bytes:
    return np.ascontiguousarray(rows, "<f8").tobytes()


def over(session: Session, t: int) -> SessionFinished:
    return SessionFinished(
        f"session {session.id!r} is over: no further step is decided",
        path="t",
        got=t,
        expected="a step already decided, to read it again",
    )
