"""Sessions: what a step, a close and a reading back do to what is stored."""

from __future__ import annotations

import asyncio
import json
import math
import os
import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import Any, TypeVar

import numpy as np

from specshield.arrays import Floats
from specshield.errors import Conflict, FragmentError, InfeasibleStart, InputError, LimitReached, NotFound
from specshield.lookahead.lookahead import AHEADS
from specshield.lookahead.preferences import PROJECTION, check_shaping, prepare
from specshield.robot.dynamics import make_body
from specshield.rule.view import view_of
from specshield.service.library import files
from specshield.service.library.policies import Description, Policies
from specshield.service.schemas.sessions import SessionRequest
from specshield.service.schemas.steps import CloseRequest, StepRequest
from specshield.service.sessions.session import (
    Session,
    State,
    check_step,
    columns,
    describe,
    digest_of,
    encode,
    lines,
    over,
    pack,
    replay,
)
from specshield.service.settings import Settings
from specshield.service.storage.store import Change, Record, Store
from specshield.shield import episode
from specshield.shield.decision import Carry, Config, Decision, Shield, check_preferring, make_shield
from specshield.shield.preference import Preference

R = TypeVar("R")
RACES = 10  # writes lost to others before a caller is told so
CONFIG = ("seed", "threshold", "margin", "slack", "evaluation", "max_steps")


class Sessions:
    """Decisions run in threads (the rollouts release the interpreter); the store is awaited."""

    def __init__(self, settings: Settings, store: Store, policies: Policies) -> None:
        self._settings, self._store, self._policies = settings, store, policies
        self._shields = files.Recent[Shield](settings.shield_cache)
        self._threads = ThreadPoolExecutor(os.cpu_count() or 1, "decide")
        self._preferences = files.Recent[Future[Preference]](AHEADS)
        self._preparing = ThreadPoolExecutor(1, "prepare")
        self._latest: Future[Preference] | None = None  # the last one that was asked for

    async def create(self, request: SessionRequest) -> dict[str, Any]:
        """Raises NotFound, PolicyError, PoseError, InfeasibleStart, SessionExists, LimitReached."""
        await self._check_room()
        settings = self._checked(request)
        preference = None
        if request.shaping != PROJECTION:
            preference = await self._prepared(request)
        config, state, rows = await self._run(self._begin, request, settings, preference)
        change = Change(files.to_json(asdict(state)), pack(rows))
        await self._store.create(config["id"], files.to_json(config), change)
        return describe(config, state)

    def _checked(self, request: SessionRequest) -> Config:
        """The session's settings. Raises InputError for those that cannot be had."""
        if (request.max_steps or 0) > self._settings.max_steps:
            expected = f"at most {self._settings.max_steps}"
            raise InputError("too many steps", path="max_steps", got=request.max_steps, expected=expected)
        check_shaping(request.shaping)
        config = Config(**{name: getattr(request, name) for name in CONFIG})
        if request.shaping != PROJECTION:
            check_preferring(config)
        return config

    def _begin(
        self, request: SessionRequest, settings: Config, preference: Preference | None
    ) -> tuple[dict[str, Any], State, Floats]:
        records = [self._policies.record(key) for key in request.policies]
        ids = [record.id for record in records]
        shield = replace(self._shield(ids, settings), preference=preference)
        feasible = True
        try:
            episode.start(shield, request.initial_pose)
        except InfeasibleStart:
            if not request.allow_infeasible:
                raise
            feasible = False
        task, about = shield.task, records[0].about
        signals = {name: task.signals[name] for name in sorted(task.signals)}
        rows = np.array([[*request.initial_pose, *signals.values()]])
        status, _ = episode.close(shield, rows[:, :3], columns(rows, signals))
        config = {
            "id": request.id or f"{time.time_ns() // 1_000_000:012x}-{secrets.token_hex(8)}",
            "policy_ids": ids,
            "map_id": about.map_id,
            "spec": {
                "formula": str(task.formula),
                "regions": about.spec.get("regions") or {},
                "signals": signals,
            },
            "robot": about.robot,
            "horizon": task.horizon,
            "actions": list(task.robot.action_names),
            "terminal_actions": np.flatnonzero(task.robot.terminal).tolist(),
            **{name: getattr(settings, name) for name in CONFIG},
            "shaping": request.shaping,
            "max_steps": shield.max_steps,
            "created_at": files.now(),
            "nonce": secrets.token_hex(8),
        }
        return config, State(1, 0, feasible, status, self._expiry()), rows

    async def read(self, id: str) -> dict[str, Any]:
        session = Session.of(await self._load(id))
        return describe(session.config, session.state)

    async def page(self, after: str | None, limit: int) -> tuple[list[dict[str, Any]], str | None]:
        found, following = await self._store.page(after, limit)
        return [
            describe(json.loads(config), State(**json.loads(state))) for config, state in found
        ], following

    async def delete(self, id: str) -> None:
        if not await self._store.delete(id):
            raise _missing(id)

    async def step(self, id: str, request: StepRequest, timing: dict[str, float]) -> tuple[bytes, str | None]:
        """The answer, and its mode; None for a replay. `timing` collects the seconds of rollout and store."""
        digest = digest_of(request)
        for _ in range(RACES):
            with _clock(timing, "store"):
                session = Session.of(await self._load(id, request.t))
            if session.step is not None:
                return replay(session, request, digest), None
            check_step(session, request)
            session, decision, answer = await self._run(self._decide, session, request, timing)
            state = replace(
                session.state,
                length=len(session.rows),
                next_t=len(session.rows),
                spec_status=decision.spec_status,
                main_task_done=request.main_task_done,
                finished=decision.finished,
                carry=decision.carry.to_json(),
                expires_at=self._expiry(),
            )
            with _clock(timing, "store"):
                if await self._append(session, state, request.t, digest + answer):
                    return answer, decision.mode
        raise _contended(id)

    def _decide(
        self, session: Session, request: StepRequest, timing: dict[str, float]
    ) -> tuple[Session, Decision, bytes]:
        shield = self._shield(
            session.config["policy_ids"],
            Config(**{name: session.config[name] for name in CONFIG if name in session.config}),
        )
        shield.task.check_signals(request.signals or {})
        session = session.extended(request.t, np.array(request.poses), request.signals or {})
        logits = None
        if request.logits is not None:
            logits = [-np.inf if value is None else value for value in request.logits]
        carry = None if session.state.carry is None else Carry.from_json(session.state.carry)
        if session.config["shaping"] != PROJECTION:
            shield = replace(shield, preference=self._preference_at_hand(shield, session))
        with _clock(timing, "rollout"):
            decision = episode.decide(
                shield,
                session.poses,
                logits,
                request.main_task_done,
                session.signals,
                carry,
                request.witnesses,
            )
        return session, decision, encode(decision, request.witnesses)

    async def close(self, id: str, request: CloseRequest) -> dict[str, Any]:
        """The session, with `robustness_bounds` beside its fields. Closing again changes nothing."""
        for _ in range(RACES):
            session = Session.of(await self._load(id))
            state = session.state
            if request.t is not None and request.poses is not None:
                last = session.config["max_steps"] + 1  # where the last step led
                if request.t > last:
                    raise InputError(
                        f"step {request.t} is past the session's last", path="t", got=request.t,
                        expected=f"at most {last}",
                    )  # fmt: skip
                session = session.extended(request.t, np.array(request.poses), {})
                if state.closed and len(session.rows) > state.length:
                    raise over(session, request.t)
            status, bounds = await self._run(self._verdict, session)
            if not state.closed:
                state = replace(
                    state,
                    length=len(session.rows),
                    spec_status=status,
                    finished=True,
                    closed=True,
                    expires_at=self._expiry(),
                )
                if not await self._append(session, state, None, b""):
                    continue
            finite = [value if math.isfinite(value) else None for value in bounds]
            return {**describe(session.config, state), "robustness_bounds": finite}
        raise _contended(id)

    def _verdict(self, session: Session) -> tuple[str, tuple[float, float]]:
        """Needs no policy, since those of a session that is over may have been deleted."""
        config = session.config
        task = self._policies.task(Description(config["map_id"], config["robot"], config["spec"], "", 0, {}))
        body, view = make_body(task.robot, task.grid), view_of(task, task.formula)
        shield = Shield(task, (), Config(), body, view)
        return episode.close(shield, session.poses, session.signals)

    async def trajectory(self, id: str) -> Iterator[bytes]:
        """One JSON object a step: t, pose, signals, and the answer that was given."""
        session = Session.of(await self._load(id))
        steps = await self._store.steps(id)
        return lines(session, steps)

    async def using(self, policy_id: str) -> str | None:
        """A session that may still ask this policy, if there is one."""
        after = None
        while True:
            found, after = await self._store.page(after, 1000)
            for config, state in found:
                fixed = json.loads(config)
                if policy_id in fixed["policy_ids"] and not json.loads(state)["finished"]:
                    return str(fixed["id"])
            if after is None:
                return None

    async def _load(self, id: str, t: int | None = None) -> Record:
        found = await self._store.load(id, t)
        if found is None:
            raise _missing(id)
        return found

    async def _append(self, session: Session, state: State, t: int | None, step: bytes) -> bool:
        """Writes only what is new, and row 0 once more with the first step, which brings its signals."""
        first = min(session.state.length, len(session.rows) - 1)
        offset = first * 8 * session.rows.shape[1]
        change = Change(files.to_json(asdict(state)), pack(session.rows[first:]), offset, t, step)
        return await self._store.append(session.id, session.version, change)

    async def _check_room(self) -> None:
        limit = self._settings.max_sessions
        if await self._store.count() < limit:
            return
        after: str | None = None  # reading them all drops the names of those that have expired
        while True:
            _, after = await self._store.page(after, 1000)
            if after is None:
                break
        if await self._store.count() >= limit:
            raise LimitReached(
                f"the server keeps no more than {limit} sessions",
                expected="room for one more: delete a session, or wait until one expires",
            )

    def _shield(self, policy_ids: Sequence[str], config: Config) -> Shield:
        def make() -> Shield:
            return make_shield([self._policies.policy(self._policies.record(id)) for id in policy_ids])

        return replace(self._shields.get(tuple(policy_ids), make), config=config)

    async def _prepared(self, request: SessionRequest) -> Preference:
        """The preference that a session asks for. Preparing it takes seconds, in a thread of its own, so that
        no decision waits for it.
        """

        def begin() -> Future[Preference]:
            ids = [self._policies.record(key).id for key in request.policies]
            return self._prepare(request.shaping, ids, self._shield(ids, Config()), request.initial_pose)

        try:
            return await asyncio.shield(asyncio.wrap_future(await self._run(begin)))
        except FragmentError as error:
            raise FragmentError(
                f"{request.shaping!r} cannot be had for this formula: {error.message}", path="shaping",
                got=request.shaping, expected="'projection', or a formula that 'reachability' takes",
            ) from None  # fmt: skip

    def _prepare(
        self, name: str, policy_ids: Sequence[str], shield: Shield, pose: Sequence[float]
    ) -> Future[Preference]:
        def begin() -> Future[Preference]:
            self._latest = self._preparing.submit(prepare, name, shield.task, shield.proposers, pose)
            return self._latest

        return self._preferences.get((name, *policy_ids), begin)

    def _preference_at_hand(self, shield: Shield, session: Session) -> Preference | None:
        """The session's preference if this process has prepared it; until then the session projects.

        What is missing is begun, unless another is being prepared: with more tasks than are kept they would
        pile up, and whoever creates a session would wait for them all.
        """
        name, ids = session.config["shaping"], session.config["policy_ids"]
        found = self._preferences.peek((name, *ids))
        if found is None and (self._latest is None or self._latest.done()):
            found = self._prepare(name, ids, shield, session.poses[-1])
        return found.result() if found is not None and found.done() and found.exception() is None else None

    async def _run(self, function: Callable[..., R], *args: Any) -> R:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *args)

    def _expiry(self) -> float:
        return time.time() + self._settings.session_ttl


@contextmanager
def _clock(timing: dict[str, float], name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    timing[name] = timing.get(name, 0.0) + time.perf_counter() - start


def _missing(id: str) -> NotFound:
    return NotFound(
        f"there is no session {id!r}; it may have expired",
        path="id",
        got=id,
        expected="an id from /v1/sessions",
    )


def _contended(id: str) -> Conflict:
    return Conflict(
        f"several callers write to session {id!r} at once", path="id", got=id, expected="one caller a session"
    )
