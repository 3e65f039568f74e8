"""A session in process: what the SDK's `Session` is, decided here."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from types import TracebackType
from typing import Any

import numpy as np

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
from specshield.client.wire import Logits, Numbers, Points, logit_values, point_values, pose_values
from specshield.errors import HistoryConflict, SessionFinished, StepConflict
from specshield.robot.dynamics import wrap
from specshield.shield import decision as core
from specshield.shield import episode
from specshield.shield.decision import Carry, Shield
from specshield.task import Task, check_signals

OWN = ("execute", "timings", "source", "action_names")  # what the SDK adds to the answer of the contract
ASKED = ("witnesses", "explanations", "any_signal")  # what an answer has where there is something to say


class LocalSession:
    """As `specshield.client.Session`: `t` is the next step, and a `step` that raises leaves all as it was."""

    def __init__(self, shield: Shield, info: SessionInfo, initial_pose: Pose) -> None:
        self.info = info
        self.t = 0
        self.spec_status: SpecStatus = info.spec_status
        self.finished = self.main_task_done = self.closed = False
        self._shield, self._initial = shield, initial_pose
        self._carry: Carry | None = None
        self._poses: list[Pose] = []
        self._signals: dict[str, list[float]] = {name: [] for name in shield.task.signals}
        self._decisions: dict[int, Decision] = {}

    @property
    def id(self) -> str:
        return self.info.id

    @property
    def task(self) -> Task:
        """The map, the robot and the rule."""
        return self._shield.task

    def __enter__(self) -> LocalSession:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
    ) -> Decision:
        """Decide step t from x_t = (x, y, theta) and one logit an action; run `decision.execute`.

        The arguments are those of the SDK's `Session.step`, but for its `deadline`: nothing is waited for.
        Raises what that raises where the caller is wrong.
        """
        over = self.main_task_done if main_task_done is None else main_task_done
        self._check(over)
        check_signals(self._shield.task, signals or {})
        x_t = self._at(pose)
        held = self._held(signals or {})
        made = episode.decide(
            self._shield,
            np.array([*self._poses, x_t]),
            None if logits is None else _log(logits),
            over,
            {name: np.array(values) for name, values in held.items()},
            self._carry,
            witnesses,
            None if occupied is None else np.array(point_values(occupied, "occupied")).reshape(-1, 2),
            None if free is None else np.array(point_values(free, "free")).reshape(-1, 2),
            explain,
        )
        answer = _answer(made, self.info, over, witnesses, explain)
        self._poses.append(x_t)
        self._signals, self._carry, self._decisions[self.t] = held, made.carry, answer
        self.t += 1
        self.spec_status = answer.spec_status
        ends = main_task_done is None and answer.action in self.info.terminal_actions
        self.main_task_done = over or ends
        self.finished = answer.finished or (ends and answer.spec_status != "pending")
        return answer

    def record(self, pose: Numbers) -> None:
        """Note x_t of a step that goes without a decision, and move on to t + 1."""
        self._poses.append(self._at(pose))
        self._signals = self._held({}, len(self._poses))
        self.t += 1

    def close(self, pose: Numbers | None = None) -> Verdict:
        """End the session; `pose` is the state the last action led to. Closing again changes nothing."""
        if not self.closed and pose is not None:
            self.record(pose)
        poses = self._poses or [self._initial]
        signals = {name: np.array(values) for name, values in self._signals.items()}
        status, bounds = episode.close(self._shield, poses, signals)
        self.closed = self.finished = True
        self.spec_status = status
        low, high = (value if math.isfinite(value) else None for value in bounds)
        return Verdict(status, (low, high))

    def trajectory(self) -> tuple[TrajectoryItem, ...]:
        """The states x_0..x_t, and the answers by the contract's names."""
        held = self._held({}, len(self._poses))
        return tuple(
            TrajectoryItem(t, pose, {name: values[t] for name, values in held.items()}, self._told(t))
            for t, pose in enumerate(self._poses)
        )

    def _check(self, over: bool) -> None:
        if self.finished:
            raise SessionFinished(
                "the session is over: no further step is decided",
                path="t",
                got=self.t,
                expected="a new session",
            )
        if self.main_task_done and not over:
            raise StepConflict(
                "an earlier step said that the main task is done, which cannot be taken back",
                path="main_task_done", got=False, expected="true",
            )  # fmt: skip

    def _at(self, pose: Numbers) -> Pose:
        """x_t. Raises HistoryConflict where x_0 is not where the session began."""
        x_t = pose_values(pose)
        if self.t > 0:
            return x_t
        gap = [a - b for a, b in zip(x_t, self._initial, strict=True)]
        if max(abs(gap[0]), abs(gap[1]), abs(wrap(gap[2]))) > episode.SAME_POSE:
            raise HistoryConflict(
                "the session began elsewhere", path="pose", got=list(x_t), expected=f"{list(self._initial)}"
            )
        return self._initial

    def _held(self, sent: Mapping[str, float], length: int | None = None) -> dict[str, list[float]]:
        """The signals up to `length` steps, by default those with the step that is decided now. A signal
        that is not sent holds its last value.
        """
        n, first = len(self._poses) + 1 if length is None else length, self._shield.task.signals
        held = {}
        for name, values in self._signals.items():
            known = values[-1] if values else first[name]
            grown = values + [known] * (n - len(values))
            held[name] = [*grown[:-1], float(sent[name])] if name in sent else grown
        return held

    def _told(self, t: int) -> Mapping[str, Any] | None:
        decision = self._decisions.get(t)
        if decision is None:
            return None
        told = {each.name: getattr(decision, each.name) for each in fields(decision) if each.name not in OWN}
        told["residual"] = None if decision.residual is None else dict(vars(decision.residual))
        if decision.explanations is not None:
            told["explanations"] = [None if e is None else dict(vars(e)) for e in decision.explanations]
        return {name: value for name, value in told.items() if value is not None or name not in ASKED}


def _log(logits: Logits) -> list[float]:
    return [-math.inf if value is None else value for value in logit_values(logits)]


def _answer(made: core.Decision, info: SessionInfo, over: bool, witnesses: bool, explain: bool) -> Decision:
    """The decision of the core as the SDK has it."""
    names = {each.name for each in fields(Decision)}
    values = {name: value for name, value in vars(made).items() if name in names}
    values |= {
        "distribution": tuple(made.distribution.tolist()),
        "next_poses": tuple(map(tuple, made.next_poses.tolist())),
        "residual": None if made.residual is None else Residual(*made.residual),
        "witnesses": made.witnesses if witnesses else None,
        "explanations": _explained(made) if explain else None,
        "timings": {},
    }
    execute = execute_of(values, info.terminal_actions, over)
    return Decision(**values, execute=execute, action_names=info.actions)


def _explained(made: core.Decision) -> tuple[Explanation | None, ...]:
    return tuple(
        None
        if why is None
        else Explanation(why.conjunct, why.robustness if math.isfinite(why.robustness) else None, why.late_by)
        for why in made.explanations
    )
