"""Begins, lists, closes, reads back and erases sessions. steps.py decides their steps."""

from __future__ import annotations

import asyncio
import math
import secrets
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any, TypeVar

import msgspec
import numpy as np

from specshield import __version__, episode
from specshield.arrays import Floats
from specshield.caution.signals import any_signal
from specshield.episode import handover
from specshield.errors import InputError, LimitReached, NotFound, SpecshieldError
from specshield.lookahead.preferences import PROJECTION, check_shaping
from specshield.reasons import refusal
from specshield.service.access.keys import OPEN, Key
from specshield.service.heavy.heavy import Heavy
from specshield.service.heavy.threads import Threads
from specshield.service.library import files
from specshield.service.library.policies import Policies
from specshield.service.schemas.sessions import SessionRequest
from specshield.service.schemas.steps import CloseRequest
from specshield.service.sessions import chain, record, rules
from specshield.service.sessions.rules import Rule, asked_by, asked_for, stored
from specshield.service.sessions.session import (
    RACES,
    Session,
    check_last,
    contended,
    describe,
    missing,
    needed,
    pack,
    there,
)
from specshield.service.sessions.shields import Shields
from specshield.service.sessions.state import State
from specshield.service.sessions.steps import Steps, Tell
from specshield.service.sessions.switch import Switches
from specshield.service.settings import Settings
from specshield.service.storage.archiving import ArchivingStore
from specshield.service.storage.store import Change, Limit, exists, no_more, scoped
from specshield.shield.decision import USUAL_STEPS, Config, check_preferring
from specshield.shield.preference import Preference
from specshield.world.learned import LearnedMap

R = TypeVar("R")
Begun = tuple[Rule, State, Floats]  # the state but for `expires_at`, the first row


class Sessions:
    """All that takes long runs in threads or other processes, so that the event loop goes on. In these
    methods the `id` of a session is its key in the store, which says whose it is (storage/store.py).
    """

    def __init__(
        self,
        settings: Settings,
        store: ArchivingStore,
        policies: Policies,
        heavy: Heavy,
        tell: Tell,
        is_compiled: Callable[[str], bool],
    ) -> None:
        self._settings, self._store, self._policies = settings, store, policies
        self._shields = Shields(policies, is_compiled)
        self._threads = Threads()
        self.steps = Steps(store, self._shields, self._threads, heavy, settings.session_ttl, tell)
        self.switches = Switches(store, self._shields, self._run, heavy, settings)
        self._heavy = heavy

    async def create(self, request: SessionRequest, key: Key = OPEN) -> dict[str, Any]:
        """Raises NotFound, PolicyError, PoseError, InfeasibleStart, SessionExists, LimitReached."""
        try:
            limits = await self._check_room(key)
        except LimitReached:  # not for a session that was made by an earlier try whose answer was lost
            id = scoped(key.name, request.id or "")
            if request.id is not None and await self._store.load(id) is not None:
                raise exists(id) from None
            raise
        if self._settings.redis_url is None:  # the embedded store writes to this disk
            files.check_free(self._settings.data_dir, self._settings.disk_reserve_bytes)
        settings = self._checked(request)
        preference = None
        if request.shaping != PROJECTION:
            about = request.shaping, request.policies, request.initial_pose, key.name
            preference = await self._shields.prepared(self._run, *about)
        found = await self._run(lambda: [self._policies.find(id, key.name) for id in request.policies])
        if (last := found[0].horizon) > (most := self._settings.max_steps):
            told = "the rule ends after the last step that a session can have"
            raise InputError(told, path="policy_id", got=f"step {last}", expected=f"at most step {most}")
        ids = [record.id for record in found]
        longest = min(self._settings.max_horizon, self._settings.max_steps)
        asked = request, settings, preference, key.name, longest
        try:  # in another process where the policies' decisions take long, else in a thread
            if preference is None and await self._run(self._shields.slow_policies, ids):
                rule, state, rows = await self._heavy.decide(begin, *asked, session=",".join(ids), key=ids)
            else:
                rule, state, rows = await self._run(begin, self._shields, *asked)
        except Exception:  # where a policy was deleted meanwhile, that is the error to tell of
            await self._policies.still_there(ids, key.name)
            raise
        state = msgspec.structs.replace(state, expires_at=time.time() + self._settings.session_ttl)
        stored_as = scoped(key.name, rule.id)
        change = Change(state.packed(), pack(rows))
        await self._store.create(stored_as, rules.line(rule), change, *limits)
        try:  # a deletion of a policy sees this session from now on; an earlier one has left a mark
            await self._policies.still_there(rule.policy_ids, key.name)
        except SpecshieldError:
            await self._store.delete(stored_as)
            raise
        return describe([rule], state)

    def _checked(self, request: SessionRequest) -> Config:
        """The session's settings. Raises InputError for settings that are not allowed."""
        if (request.max_steps or 0) > self._settings.max_steps:
            expected = f"at most {self._settings.max_steps}"
            raise InputError("too many steps", path="max_steps", got=request.max_steps, expected=expected)
        check_shaping(request.shaping)
        config = asked_for(request)
        if config.max_steps is None and self._settings.max_steps < USUAL_STEPS:
            config = replace(config, max_steps=self._settings.max_steps)
        if request.shaping != PROJECTION:
            check_preferring(config)
        return config

    async def read(self, id: str) -> dict[str, Any]:
        session = Session.of(there(await self._store.load(id), id))
        return describe(session.rules, session.state)

    async def page(
        self, owner: str, after: str | None, limit: int
    ) -> tuple[list[dict[str, Any]], str | None]:
        found, following = await self._store.everything(owner, after, limit)
        shown = list[dict[str, Any]]()
        for config, state in found:
            item = describe(rules.read(config), State.of(state))
            # A rule may have many regions: callers who want them read the session.
            item["spec"] = {name: held for name, held in item["spec"].items() if name != "regions"}
            del item["robot"]
            shown.append(item)
            await asyncio.sleep(0)  # lets other requests run: a config of many regions takes a millisecond
        return shown, following

    async def delete(self, id: str) -> None:
        self.steps.recent.drop(id)
        if not await self._store.delete(id):
            raise missing(id)

    async def close(self, id: str, request: CloseRequest) -> dict[str, Any]:
        """The session's description with `robustness_bounds`, which are null where the map was deleted since.
        Closing a closed session changes nothing.
        """
        for _ in range(RACES):
            session = Session.of(there(await self._store.load(id), id))
            state = session.state
            if request.t is not None and request.poses is not None:
                check_last(request.t, session.rule.max_steps + 1)  # where the last step led
                session = session.extended(request.t, np.array(request.poses), {})
                if state.closed and len(session.rows) > state.length:
                    raise session.over(request.t)
            session, status, bounds = await self._run(self._closed, session)
            if not state.closed:
                state = msgspec.structs.replace(
                    session.state,
                    length=len(session.rows),
                    spec_status=status,
                    finished=True,
                    closed=True,
                    expires_at=time.time() + self._settings.session_ttl,
                )
                change = Change(state.packed(), *session.added(session.state.length))
                if not isinstance(await self._store.append(id, session.version, change), bytes):
                    continue
            self.steps.recent.drop(id)
            return {**describe(session.rules, state), "robustness_bounds": list(map(handover.finite, bounds))}
        raise contended(id)

    def _closed(self, session: Session) -> tuple[Session, str, tuple[float, float]]:
        session = self._shields.settled(session)
        try:
            return session, *self._shields.verdict(session.rule, session.rows, session.signal_names)
        except NotFound:  # the map of a session that has ended may have been deleted
            if not session.state.finished:
                raise
            return session, session.state.spec_status, (-math.inf, math.inf)

    async def trajectory(self, id: str, after: int) -> tuple[Iterator[bytes], bytes]:
        """One JSON object for each later step (`Session.lines`), and the rules as one JSON list."""
        found = there(await self._store.dump(id), id)
        session = Session.of(found)
        rules = files.to_json(describe(session.rules, session.state)["rules"])
        return session.lines(found.steps, after), rules

    async def record(self, id: str) -> tuple[bytes, str]:
        """The session's record as a file, and its seal."""
        found = there(await self._store.dump(id), id)
        return await self._run(chain.pack, found.config, pack(Session.of(found).rows), found.steps)

    async def learned(self, id: str) -> bytes:
        """What the session learned of its map, as JSON."""
        session = Session.of(there(await self._store.load(id), id))
        return await self._run(session.learned)

    async def last(self, id: str) -> tuple[Rule, int, Floats, bytes, LearnedMap]:
        """What a picture needs: the session's rule, its last step, the rows since it came to its map, the
        record of the last step, b"" if the rule in force did not decide that, and what it learned of the map.
        """
        found = there(await self._store.dump(id), id)
        session = Session.of(found)
        t = len(session.rows) - 1
        decided = session.rule.begins <= t < len(found.steps)
        came = (b.begins for a, b in pairwise(session.rules) if a.map_id != b.map_id)
        rows = session.rows[max(came, default=0) :]
        return session.rule, t, rows, found.steps[t] if decided else b"", session.state.learned

    async def using(self, owner: str, policy_id: str) -> str | None:
        """The id of a session of this owner, in the store or the archive, that still needs this policy."""
        after = None
        while True:
            found, after = await self._store.everything(owner, after, 1000)
            for config, state in found:
                had, now = rules.read(config), State.of(state)
                if not now.finished and policy_id in needed(had, now):
                    return had[-1].id
            if after is None:
                return None

    async def _check_room(self, key: Key) -> list[Limit]:
        """The limits on the number of sessions that apply to a caller. Raises LimitReached."""
        archived = self._store.archived
        for whose, size, setting in (
            ("this key's", archived.get(key.name, 0) if key.name else 0, "max_owner_archive_bytes"),
            ("all", sum(archived.values()), "archive_bytes"),
        ):
            if size >= (most := getattr(self._settings, setting)):
                told = f"{whose} sessions in the archive take {size} of {most} bytes, so none can begin"
                variable = f"SPECSHIELD_{setting.upper()}"
                expected = f"room: delete sessions there; the server's operator can raise {variable}"
                raise LimitReached(told, expected=expected)
        both = ((None, self._settings.max_sessions), (key.name, key.sessions))
        limits: list[Limit] = [(owner, most) for owner, most in both if most is not None]
        for owner, most in limits:
            if await self._store.count(owner) >= most:
                await self._store.sweep(owner)
                if await self._store.count(owner) >= most:
                    raise no_more(most)
        return limits

    async def _run(self, function: Callable[..., R], *args: Any) -> R:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *args)


def begin(
    shields: Shields,
    request: SessionRequest,
    settings: Config,
    preference: Preference | None,
    owner: str,
    longest: int,
) -> Begun:
    """Checks that a session can begin, and makes what is stored of it. preference: for `request.shaping`.
    longest: the longest horizon that a rule may have [steps].
    """
    records = [shields.policies.find(key, owner) for key in request.policies]
    ids = [record.id for record in records]
    shield = replace(shields.get(ids, settings), preference=preference)
    feasible, way = refusal.begin(shield, request.initial_pose, request.allow_infeasible, longest)
    task, about = shield.task, records[0].about
    signals = dict(sorted(task.signals.items()))
    rows = np.array([[*request.initial_pose, *signals.values()]])
    status, _ = episode.close(shield, rows[:, :3], rules.signals_in(rows, signals))
    rule = Rule(
        id=request.id or f"{time.time_ns() // 1_000_000:012x}-{secrets.token_hex(8)}",
        **asked_by(ids, about, task),
        **{**stored(settings, request), "max_steps": shield.max_steps},
        shaping=request.shaping,
        created_at=files.now(),
        owner=owner,
        nonce=secrets.token_hex(8),
        version=__version__,
        way=(way or b"").hex(),
    )
    state = State(
        length=1,
        next_t=0,
        feasible=feasible,
        spec_status=status,
        expires_at=0.0,
        head=record.digest(rules.line(rule)),
        carry=handover.begun(rule.found),
        any_signal=any_signal(shield, rows[:, :3]),
    )
    return rule, state, rows
