"""Switches a session to another rule, map or robot from step t on. A switch is written as a step is."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from specshield import __version__, episode
from specshield.arrays import Floats
from specshield.caution.signals import any_signal
from specshield.errors import InputError, LimitReached, SpecshieldError
from specshield.lookahead.preferences import PROJECTION
from specshield.reasons import refusal
from specshield.service.heavy.heavy import Heavy
from specshield.service.schemas.sessions import SwitchRequest
from specshield.service.sessions import history, record, rules
from specshield.service.sessions.rules import asked_by
from specshield.service.sessions.session import RACES, Session, check_last, contended, describe, pack, there
from specshield.service.sessions.shields import Run, Shields
from specshield.service.settings import Settings
from specshield.service.storage.store import Change, Store
from specshield.shield.decision import Config


class Switches:
    """A switch that is refused changes nothing."""

    def __init__(self, store: Store, shields: Shields, run: Run, heavy: Heavy, settings: Settings) -> None:
        self._store, self._policies, self._shields = store, shields.policies, shields
        self._run, self._heavy = run, heavy
        self._ttl, self._longest = settings.session_ttl, (settings.max_steps, settings.max_horizon)

    async def make(self, id: str, request: SwitchRequest, owner: str) -> dict[str, Any]:
        """Makes a switch and returns the session's description. Raises NotFound, InfeasibleSwitch, PoseError,
        HistoryGap, HistoryConflict, StepConflict, SessionFinished, LimitReached.
        """
        for _ in range(RACES):
            found = there(await self._store.load(id, request.t - 1 if request.t else None), id)
            session = Session.of(found)
            ids = await self._run(lambda: [self._policies.find(key, owner).id for key in request.policies])
            if _is_last(session, request, ids):
                return describe(session.rules, session.state)
            wanted = _wanted(session, request, ids, found.step)
            made = await self._made(wanted, owner)
            before, after = session.rows.shape[1], made.rows.shape[1]
            rows = made.added(session.state.length) if before == after else (pack(made.rows), 0)
            state = msgspec.structs.replace(made.state, expires_at=time.time() + self._ttl)
            change = Change(state.packed(), *rows, config=b"\n".join([found.config, rules.line(made.rule)]))
            version = await self._store.append(id, session.version, change)
            if not isinstance(version, bytes):
                continue
            try:  # a deletion of a policy sees this session from now on; an earlier one has left a mark
                await self._policies.still_there(ids, owner)
            except SpecshieldError:
                await self._store.append(id, version, Change(found.state, found.rows, config=found.config))
                raise
            return describe(made.rules, state)
        raise contended(id)

    async def _made(self, wanted: Wanted, owner: str) -> Session:
        """The session under its new rule, made in a thread, or in another process for slow policies."""
        session, ids = wanted.session, wanted.policy_ids
        shaping = session.rule.shaping
        if shaping == PROJECTION and await self._run(self._shields.slow_policies, ids):
            asked = switched, wanted, *self._longest
            return await self._heavy.decide(*asked, session=session.id, key=ids)
        if shaping != PROJECTION:
            await self._shields.prepared(self._run, shaping, ids, wanted.row[:3].tolist(), owner)
        here: Session = await self._run(switched, self._shields, wanted, *self._longest)
        return here


class Wanted(NamedTuple):
    """A switch at step t of `session`, which has the poses that came with the request. row [3 + signals]: of
    x_t, as the last decision foresaw it where the session does not have it yet.
    """

    session: Session
    t: int
    policy_ids: Sequence[str]
    clock: str
    row: Floats


def _is_last(session: Session, request: SwitchRequest, policy_ids: Sequence[str]) -> bool:
    """Whether the session's last switch is this one, which was sent again. Raises HistoryConflict if it was
    made from another x_t.
    """
    if len(session.rules) == 1:
        return False
    last = session.rule
    made = last.begins, last.policy_ids, last.clock
    if made != (request.t, list(policy_ids), request.clock):
        return False
    if request.poses is not None:
        history.join(session.poses, request.t, np.array(request.poses))
    return True


def _wanted(
    session: Session, request: SwitchRequest, policy_ids: Sequence[str], step: bytes | None
) -> Wanted:
    """Checks the request. step: the record of step t - 1, None if that has none."""
    t = request.t
    session.check_ahead(t, f"step {t} is decided, or was passed over: no other rule can hold there")
    if len(session.rules) >= rules.MOST_RULES:
        told = f"a session has at most {rules.MOST_RULES} rules"
        raise LimitReached(told, expected="a new session for what follows")
    if request.poses is not None:
        session = session.extended(t, np.array(request.poses), {})
    if len(session.rows) > t:
        return Wanted(session, t, policy_ids, request.clock, session.rows[t])
    if len(session.rows) < t or step is None:
        told = f"the server does not know where the robot is at step {t}"
        raise history.gap(told, None, len(session.rows), t)
    row = session.rows[-1].copy()
    row[:3] = _foreseen(session, step)
    return Wanted(session, t, policy_ids, request.clock, row)


def _foreseen(session: Session, step: bytes) -> Sequence[float]:
    """The pose to which the last decision's action leads, which the SDK calls `execute`. The robot is the one
    of that decision: an earlier switch at the same step may have brought another one.
    """
    rule = session.rules[rules.at(session.rules, len(session.rows) - 1)]
    answer = record.answer(record.decode(step), session.rows[-1], rule.actions)
    action: int | None = answer.action
    if action in rule.terminal_actions:
        action = answer.completion_action
    return session.rows[-1, :3].tolist() if action is None else answer.next_poses[action]


def switched(shields: Shields, wanted: Wanted, most_steps: int, longest: int) -> Session:
    """The session under its new rule. most_steps: that a session may have; longest: the longest horizon of a
    rule [steps]. Raises PoseError, InfeasibleSwitch, InputError, StoreError.
    """
    session, t, old = shields.settled(wanted.session), wanted.t, wanted.session.rule
    about = shields.policies.record(wanted.policy_ids[0]).about
    task = shields.get(wanted.policy_ids, Config()).task
    origin = t if wanted.clock == "restart" else old.origin
    last, most_steps = origin + task.horizon + 1, max(most_steps, old.max_steps)
    if last > most_steps:
        told = "the rule ends after the last step that a session can have"
        expected = f"at most step {most_steps}"
        raise InputError(told, path="policy_id", got=f"step {last}", expected=expected)
    most = max(old.max_steps, last)
    check_last(t, most)
    signals = task.signals
    names = [*session.signal_names, *rules.added(session.signal_names, signals)]
    if len(names) > record.MOST_SIGNALS:
        told = "the session's rules have too many signals together"
        expected = f"at most {record.MOST_SIGNALS}; or a new session for this rule"
        raise InputError(told, path="policy_id", got=len(names), expected=expected)
    before = record.link(session.state.head, session.rows[session.state.next_t : t])
    rule = msgspec.structs.replace(
        old,
        **asked_by(wanted.policy_ids, about, task),
        max_steps=most,
        begins=t,
        origin=origin,
        clock=wanted.clock,
        before=before.hex(),
        version=__version__,
        way="",
    )
    verdict, _ = shields.verdict(old, session.rows, session.signal_names)
    made = session._replace(
        rules=[*session.rules, rule],
        settings=rule.settings,
        rows=rules.widened(session.rows, session.signal_names, signals),
        signal_names=names,
    )
    carry, _ = session.state.carry, session.state.learned  # raises StoreError for what cannot be read
    known = rules.carried_over(carry, old, rule)
    seen = rules.widened(np.vstack([session.rows[:t], wanted.row]), session.signal_names, signals)[origin:]
    shield = shields.of(made)
    elsewhere = (old.map_id, old.robot) != (rule.map_id, rule.robot)
    longest = min(longest, most_steps - origin - 1)
    way = refusal.switch(shield, seen[:, :3], rules.signals_in(seen, names), known, elsewhere, longest)
    rule = msgspec.structs.replace(rule, way=(way or b"").hex())
    rows = made.since
    status = episode.close(shield, rows[:, :3], rules.signals_in(rows, names))[0] if len(rows) else "pending"
    state = msgspec.structs.replace(
        session.state,
        length=len(made.rows),
        next_t=t,
        feasible=True,
        spec_status=status,
        head=record.digest(rules.line(rule)),
        carry=known._replace(way=way),
        verdicts=(*session.state.verdicts, verdict),
        any_signal=any_signal(shield, seen[:, :3], rules.signals_in(seen, names)),
    )
    return made._replace(rules=[*session.rules, rule], state=state)
