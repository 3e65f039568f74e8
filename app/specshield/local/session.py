"""A session in this process, with the interface of the SDK's `Session`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from specshield import episode
from specshield.arrays import Floats
from specshield.caution.signals import any_signal
from specshield.caution.surprise.slip import SAME_POSE
from specshield.client import wire
from specshield.client.models import (
    Decision,
    Explanation,
    Pose,
    Residual,
    SessionInfo,
    SpecStatus,
    TrajectoryItem,
    Verdict,
    execute_of,
)
from specshield.client.wire import Logits, Numbers, Points
from specshield.client.wiring import Wiring
from specshield.episode import handover
from specshield.errors import HistoryConflict, HistoryGap, InputError, SessionFinished
from specshield.local.rule import Rule, signals_in, told
from specshield.reasons import refusal
from specshield.reasons.explanation import explanations
from specshield.robot.dynamics import wrap
from specshield.shield import decision as core
from specshield.shield.decision import Shield
from specshield.task import Task

if TYPE_CHECKING:
    from specshield.local.shield import LocalShield

OWN = ("execute", "timings", "source", "action_names")  # fields of the SDK that the contract does not have
ASKED = ("witnesses", "explanations", "any_signal", "detail")  # fields that the contract leaves out if None


class LocalSession:
    """Like `specshield.client.Session`: `t` is the next step, and a `step` that raises changes nothing.

    Three things differ, as there is no server: `switch` takes a LocalShield; `events` does not wait for
    further decisions; a `deadline` is accepted but not kept, since a decision cannot be interrupted.
    """

    def __init__(
        self,
        policy: LocalShield,
        shield: Shield,
        shaping: str,
        info: SessionInfo,
        rows: Floats,
        way: bytes | None = None,
    ) -> None:
        """rows [1, 3 + signals]: x_0 and the initial values of the signals."""
        self.info = info
        self.t = 0
        self.spec_status: SpecStatus = info.spec_status
        self.finished = self.main_task_done = self.closed = False
        self._told_done = False  # whether the last step said that the main task is done
        self._over = False  # whether a server would refuse further steps: it does not know of a drawn `end`
        self._shaping = shaping
        self._rules = [Rule(policy, shield)]
        self._names = [*shield.task.signals]  # of the signals of all rules, by column of the rows
        self._rows = rows  # up to x_{t-1}, or to x_t if the beginning or a switch has given it
        self._carry = handover.begun(way)
        self._wiring = Wiring(info.id)
        self._decisions: dict[int, Decision] = {}

    @property
    def id(self) -> str:
        return self.info.id

    @property
    def task(self) -> Task:
        """The map, the robot and the rule."""
        return self._rule.shield.task

    @property
    def _rule(self) -> Rule:
        return self._rules[-1]

    @property
    def _given(self) -> Pose | None:
        """x_t, if the beginning or a switch has given it."""
        return _pose(self._rows[self.t]) if len(self._rows) > self.t else None

    def __enter__(self) -> LocalSession:
        return self

    def __exit__(self, *_: object) -> None:
        if not self.closed:
            self.close()

    def step(
        self,
        pose: Numbers,
        logits: Logits | None = None,
        *,
        main_task_done: bool | None = None,
        signals: Mapping[str, float] | None = None,
        witnesses: bool = False,
        occupied: Points | None = None,
        free: Points | None = None,
        explain: bool = False,
        deadline: float | None = None,
    ) -> Decision:
        """Decide step t from x_t = (x, y, theta) and one logit for each action; run `decision.execute`.

        The arguments are those of the SDK's `Session.step`, so that one loop serves both; `deadline` has no
        effect. Raises the same errors of the caller.
        """
        wire.check_flags(main_task_done=main_task_done, witnesses=witnesses, explain=explain)
        over = bool(self.main_task_done if main_task_done is None else main_task_done)
        if deadline is not None:
            wire.seconds_value(deadline, "deadline")
        self._check(over)
        sent = {} if signals is None else wire.signal_values(signals)
        handover.check_signals(self._names, sent)  # signals of the session's other rules are kept too
        x_t = self._at(pose)
        rows = self._with(x_t, sent)
        since = rows[self._rule.origin :]
        made = episode.decide(
            self._rule.shield,
            since[:, :3],
            None if logits is None else [-math.inf if z is None else z for z in wire.logit_values(logits)],
            over,
            signals_in(since, self._names),
            self._carry,
            witnesses,
            None if occupied is None else np.array(wire.point_values(occupied, "occupied")).reshape(-1, 2),
            None if free is None else np.array(wire.point_values(free, "free")).reshape(-1, 2),
            explanations if explain else None,
        )
        answer = _answer(made._replace(t=self.t), self.info, over, witnesses, explain)
        self._carry, self._decisions[self.t] = made.carry, answer
        self._wiring.note(self.t, x_t, answer, executed=main_task_done is None)
        self._arrived(rows)
        self.spec_status = answer.spec_status
        ends = main_task_done is None and answer.action in self.info.terminal_actions
        self.main_task_done, self._told_done = over or ends, over
        self._over = answer.finished
        self.finished = answer.finished or (ends and answer.spec_status != "pending")
        return answer

    def record(self, pose: Numbers) -> None:
        """Note x_t of a step without a decision, and go on to t + 1. An x_t that was given before counts.

        Raises SessionFinished for a session that was closed.
        """
        if self.closed:
            raise SessionFinished("the session is closed", path="t", got=self.t, expected="a new session")
        x_t = wire.pose_values(pose)
        self._arrived(self._with(self._given or x_t))

    def switch(
        self, policy: LocalShield, *, clock: Literal["keep", "restart"] = "keep", pose: Numbers | None = None
    ) -> SessionInfo:
        """Go on under another rule, on another map or with another robot, from the next step on.

        `clock` and `pose` are those of the SDK's `Session.switch`. Raises InfeasibleSwitch if the new rule
        cannot be kept from x_t; nothing is changed then.
        """
        if not isinstance(policy, type(self._rule.policy)):
            wrong = "this is no LocalShield"
            raise InputError(wrong, path="policy", got=policy, expected="a LocalShield")
        given = self._given if pose is None else self._at(pose)
        old, made = self._rule, (policy.card["id"], self.t, clock)
        if len(self._rules) > 1 and made == (old.policy.card["id"], old.begins, old.clock):
            return self.info  # the last switch was the same one
        self._check(self.main_task_done)
        x_t = self._foreseen() if given is None else given
        rule = old.followed_by(policy, self._shaping, self.t, clock)
        added = {name: value for name, value in policy.task.signals.items() if name not in self._names}
        names, rows = [*self._names, *added], self._with(x_t)
        rows = np.hstack([rows, np.tile([*added.values()], (len(rows), 1))])
        seen, signals = rows[rule.origin :, :3], signals_in(rows[rule.origin :], names)
        same_map = self.info.map_id == policy.task.grid.content_hash
        same_robot = old.policy.card["robot"] == policy.card["robot"]
        t, later = self.t - rule.origin, rule.origin - old.origin
        carry = handover.carried_over(self._carry, same_map, same_robot, t, later)
        way = refusal.switch(rule.shield, seen, signals, carry, not (same_map and same_robot))
        rows = rows[: self.t] if given is None else rows
        have = told([*self._rules, rule], rows, names)
        info = replace(
            self.info,
            **policy.about(),
            next_t=self.t,
            feasible=True,
            spec_status=have[-1]["spec_status"],
            main_task_done=self._told_done,
            rules=have,
            any_signal=any_signal(rule.shield, seen, signals),
        )
        self._rules.append(rule)
        self._wiring = Wiring(self.id, self._wiring.said)
        self._carry, self._names, self._rows = carry._replace(way=way), names, rows
        self.info, self.spec_status, self.finished = info, info.spec_status, False
        return info

    def rule_at(self, t: int) -> str:
        """The rule that decides step t."""
        return str([rule for rule in self._rules if rule.begins <= t][-1].shield.task.formula)

    def events(self, after: int | None = None) -> Iterator[Decision]:
        """The decisions after step `after`, by default those from now on; -1: from the first. It ends at the
        first step that is not decided yet.
        """
        t = self.t if after is None else after + 1
        while t < self.t:
            if t in self._decisions:
                yield self._decisions[t]
            t += 1

    def close(self, pose: Numbers | None = None) -> Verdict:
        """End the session. `pose` is the state to which the last action led. Once is enough."""
        if not self.closed and pose is not None:
            self._arrived(self._with(self._at(pose)))
        self.spec_status, bounds = self._rule.verdict(self._rows, self._names)
        self.closed = self.finished = self._over = True
        low, high = map(handover.finite, bounds)
        return Verdict(self.spec_status, (low, high))

    def trajectory(self, after: int = -1) -> tuple[TrajectoryItem, ...]:
        """The states after step `after`, with the answers (the contract's names)."""
        samples = signals_in(self._rows, self._names)
        return tuple(
            TrajectoryItem(
                t, _pose(row), {name: float(samples[name][t]) for name in reads}, self._told(t), rule
            )
            for t, row in enumerate(self._rows)
            if t > after
            for rule in [max(i for i, each in enumerate(self._rules) if each.begins <= t)]
            for reads in [sorted(self._rules[rule].shield.task.signals)]
        )

    def _with(self, x_t: Pose, sent: Mapping[str, float] | None = None) -> Floats:
        """The rows up to x_t. A signal that is not sent keeps its last value."""
        held = dict(zip(self._names, self._rows[-1, 3:].tolist(), strict=True))
        return np.vstack([self._rows[: self.t], [*x_t, *{**held, **(sent or {})}.values()]])

    def _arrived(self, rows: Floats) -> None:
        """Goes on to step t + 1. After a switch, x_t is also the last state of the rule that was left."""
        self._rows = rows
        if 0 < self.t == self._rules[-1].begins:
            have = told(self._rules, rows, self._names)
            self.info = replace(self.info, rules=have, spec_status=have[-1]["spec_status"])
        self.t += 1

    def _check(self, over: bool) -> None:
        if self._over:
            ended = "the session is over: no further step is decided"
            raise SessionFinished(ended, path="t", got=self.t, expected="a new session")
        handover.check_main_task(self.main_task_done, over)

    def _foreseen(self) -> Pose:
        """The pose to which the last decision's action leads. Raises HistoryGap without such a decision."""
        last = self._decisions.get(self.t - 1)
        if last is None:
            told, expected = f"nothing says where the robot is at step {self.t}", f"its pose at step {self.t}"
            raise HistoryGap(told, path="pose", expected=expected)
        return _pose(self._rows[-1]) if last.execute is None else last.next_poses[last.execute]

    def _at(self, pose: Numbers) -> Pose:
        """x_t. Raises HistoryConflict if the session's beginning, or a switch, gave another x_t."""
        x_t = wire.pose_values(pose)
        told = self._given or x_t
        gap = [a - b for a, b in zip(x_t, told, strict=True)]
        if max(abs(gap[0]), abs(gap[1]), abs(wrap(gap[2]))) > SAME_POSE:
            begins = ", its initial_pose" if self.t == 0 else ""
            conflict = f"the session has another pose for step {self.t} already{begins}"
            raise HistoryConflict(conflict, path="pose", got=list(x_t), expected=f"{list(told)}")
        return told

    def _told(self, t: int) -> Mapping[str, Any] | None:
        decision = self._decisions.get(t)
        return None if decision is None else asdict(decision, dict_factory=_contract)


def _pose(row: Floats) -> Pose:
    x, y, theta = row[:3].tolist()
    return x, y, theta


def _answer(made: core.Decision, info: SessionInfo, over: bool, witnesses: bool, explain: bool) -> Decision:
    """The core's decision in the SDK's form."""
    names = {each.name for each in fields(Decision)}
    values = {name: value for name, value in made._asdict().items() if name in names}
    values |= {
        "distribution": tuple(made.distribution.tolist()),
        "next_poses": tuple(map(tuple, made.next_poses.tolist())),
        "residual": None if made.residual is None else Residual(*made.residual),
        "witnesses": made.witnesses if witnesses else None,
        "explanations": handover.explained(made, Explanation) if explain else None,
        "timings": {},
    }
    execute = execute_of(values, info.terminal_actions, over)
    return Decision(**values, execute=execute, action_names=info.actions)


def _contract(members: list[tuple[str, Any]]) -> dict[str, Any]:
    """The fields of an object of the SDK, without those that the contract does not have or leaves out."""
    return {n: value for n, value in members if n not in OWN and (value is not None or n not in ASKED)}
