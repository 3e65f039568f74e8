"""A session as its caller sees it: which step is next, which poses the server has, what is over."""

from __future__ import annotations

import contextlib
import os
from bisect import insort
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

from specshield.client import wire
from specshield.client.away import Branch, Circuit, Continuation, OnFailure, is_away
from specshield.client.calls import policies_asked
from specshield.client.core import Flow, T, Within, call, deliver, fetch
from specshield.client.events import Events
from specshield.client.models import (
    Decision,
    Learned,
    LocalDecision,
    Page,
    Pose,
    SessionInfo,
    SpecStatus,
    TrajectoryItem,
    Verdict,
    build,
    decision_of,
    under,
)
from specshield.client.resources import deciding, stepping
from specshield.client.wire import TRIES, Logits, Numbers, Points, Reply
from specshield.errors import (
    HistoryConflict,
    HistoryGap,
    NotFound,
    SessionFinished,
    SpecshieldError,
    StepConflict,
)


class SessionState:
    """What `Session` and `AsyncSession` share: all of it but the I/O.

    `t` is the next step. A `step` that raises leaves everything as it was, so it may be called again
    with the same pose and logits; or `record` takes the pose and moves on, and the next step that
    reaches the server delivers it.
    """

    def __init__(
        self,
        run: Any,
        info: SessionInfo,
        initial_pose: Numbers | None = None,
        on_failure: OnFailure = "raise",
    ) -> None:
        """run: performs a call, as the shell does."""
        self._run = run
        self.info = info
        self.on_failure = on_failure
        self.t = info.next_t
        self.spec_status: SpecStatus = info.spec_status
        self.finished = info.finished
        self.main_task_done = info.main_task_done
        self.closed = False
        self._heard = list(info.rules)  # with those that `events` was told of
        self._stored = info.next_t  # poses the server has, as far as is known
        self._poses: dict[int, Pose] = {} if initial_pose is None else {0: wire.pose_values(initial_pose)}
        self._continuation = Continuation(info.margin)
        self._circuit = Circuit()
        # The step, not passed over, of which the service may have an x_t that nobody here was told of: it was
        # asked for without an answer, by whoever had the session before, or came with a switch.
        self._unanswered = info.next_t if initial_pose is None else -1

    def __repr__(self) -> str:
        over = "over" if self.finished else f"next step {self.t}"
        return f"<{type(self).__name__} {self.id}: {over}, the rule is {self.spec_status}>"

    @property
    def id(self) -> str:
        return self.info.id

    def rule_at(self, t: int) -> str:
        """The rule that decides step t, as far as this session and its `events` have heard."""
        begun = [rule["formula"] for rule in self._heard if rule["from"] <= t]
        return str(begun[-1] if begun else self.info.spec["formula"])

    @property
    def unsent(self) -> dict[int, Pose]:
        """The poses, by step, of steps that the service has not confirmed; `record` them after a restart."""
        return {t: pose for t, pose in self._poses.items() if self._stored <= t < self.t}

    def record(self, pose: Numbers) -> None:
        """Note x_t of a step that goes without a decision (the service was away), and move on to t + 1.

        Where x_t is on the certified continuation, its next action is taken to be the one that is run.
        """
        self._poses[self.t] = wire.pose_values(pose)
        self._continuation.follow(self._poses[self.t])
        self.t += 1

    def _step(
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
    ) -> Flow[Decision | LocalDecision]:
        """Decide step t from x_t = (x, y, theta) and one logit an action; run `decision.execute`.

        `main_task_done`: leave it None to run `decision.execute`; the session then remembers a drawn
        terminal action. A caller that draws from `decision.distribution` itself says True or False.
        `logits` may be None once it is true. `deadline` [s] is a hard limit on the whole call, retries
        included, whatever the server does; without one it is five timeouts of the client.
        `occupied` and `free` are points (x, y) at which the robot's sensors see an obstacle or free floor
        now, in the map frame; `explain` has the decision say of each forbidden action what it would break.
        Raises whatever went wrong and stays at t: call again with the same pose and logits, or `record`
        the pose and move on. With `on_failure` "witness" or "stop" it raises only what the caller got wrong;
        where the service cannot answer, a `LocalDecision` says what to do. A `main_task_done` of True said
        there is remembered; signals sent there are lost. While the service is known to be away, it is asked
        again at pauses of 0.25 to 4 s, once, and steps in between cost nothing, those that say to stop too: a
        robot that stands asks again at its own pace.
        """
        yield Within(None if deadline is None else wire.seconds_value(deadline, "deadline"))
        wire.check_flags(main_task_done=main_task_done, witnesses=witnesses, explain=explain)
        x_t = wire.pose_values(pose)
        body: dict[str, Any] = {
            "logits": None if logits is None else wire.logit_values(logits),
            "main_task_done": bool(self.main_task_done if main_task_done is None else main_task_done),
            "witnesses": bool(witnesses),
            **({"explain": True} if explain else {}),
        }
        if signals is not None:
            body["signals"] = wire.signal_values(signals)
        for name, points in (("occupied", occupied), ("free", free)):
            if points is not None:
                body[name] = wire.point_values(points, name)
        own = main_task_done is None
        if self.on_failure == "raise":
            return (yield from self._decided(x_t, body, own, TRIES))
        error: SpecshieldError | None = None
        if self._circuit.due:
            try:
                tries = 1 if self._circuit.open else TRIES
                decision = yield from self._ask(x_t, lambda x_t: self._decided(x_t, body, own, tries))
                self._circuit.answered()
                return decision
            except SpecshieldError as failed:
                over = isinstance(failed, SessionFinished) and self._unanswered >= 0
                if not over and not is_away(failed):
                    raise
                self.finished, error = self.finished or over, failed
                self._circuit.failed()
        way: Branch | str = "the session was begun with on_failure='stop'"
        if self.on_failure == "witness":
            way = self._continuation.at(x_t)
        if self.finished:
            way = "the session is over"
        if isinstance(way, str):
            self.main_task_done = self.main_task_done or body["main_task_done"]
            last = self.spec_status, None, None, self.finished
            return LocalDecision(self.t, "stop", None, way, *last, error)
        return self._alone(x_t, way, body["main_task_done"], error)

    def _alone(self, x_t: Pose, way: Branch, over: bool, error: SpecshieldError | None) -> LocalDecision:
        """Follow the certified continuation through this step."""
        t, self.main_task_done = self.t, over
        self.record(x_t)
        reason = "the service cannot answer; the certified continuation is followed"
        leads = next((branch.pose for branch in self._continuation.branches), None)
        return LocalDecision(
            t, "witness", way.plan[0], reason, self.spec_status, way.plan[1:], leads, error=error
        )

    def _ask(self, pose: Numbers | None, asking: Callable[[Pose | None], Flow[T]]) -> Flow[T]:
        """What `asking` brings at t. Where the service has taken x_t here unheard, from another pose or with
        other logits, the step is passed over: the robot stood, so its pose now is that of the step after.
        """
        x_t = None if pose is None else wire.pose_values(pose)
        if self.on_failure == "raise":  # the caller is told what the service has, and goes on with `record`
            return (yield from asking(x_t))
        asked, self._unanswered = self._unanswered, self.t  # until it is heard: a caller may cancel the step
        try:
            return (yield from asking(x_t))
        except SpecshieldError as error:
            self._unanswered = self.t if is_away(error) else asked
            stored = isinstance(error, HistoryConflict) and error.details.get("t") == self.t
            taken = isinstance(error, StepConflict) and error.path != "main_task_done"
            if asked != self.t or x_t is None or not (stored or taken):
                raise
        self.record(x_t)
        self._stored = max(self._stored, self.t)
        return (yield from self._ask(x_t, asking))

    def _decided(self, x_t: Pose | None, body: Mapping[str, Any], own: bool, tries: int) -> Flow[Decision]:
        t, over, poses = self.t, body["main_task_done"], self._with(x_t)
        reply = yield from self._send("steps", poses, t, body, tries)
        decision = decision_of(wire.json_object(reply), self.info, over, wire.timings(reply))
        self._poses, self._stored, self.t, self._unanswered = poses, t + 1, t + 1, -1
        self.spec_status = decision.spec_status
        ends = own and decision.action in self.info.terminal_actions
        self.main_task_done = over or ends
        self.finished = decision.finished or (ends and decision.spec_status != "pending")
        if self.on_failure == "witness":
            self._continuation.learn(decision, poses[t])
        return decision

    def _recall(self) -> Flow[None]:
        """After a restart of the robot's process: the certified continuation, from the answers kept."""
        if self.on_failure != "witness" or self.finished:
            return
        for item in (yield from self._trajectory()) if self.t else ():
            self._continuation.branches = ()
            if item.decision is not None and item.rule == max(0, len(self.info.rules) - 1):
                decision = decision_of(item.decision, self.info, self.info.main_task_done, {})
                self._continuation.learn(decision, item.pose)

    def _switch(
        self,
        policy_id: str | None = None,
        policy_ids: Sequence[str] | None = None,
        *,
        clock: Literal["keep", "restart"] = "keep",
        pose: Numbers | None = None,
    ) -> Flow[SessionInfo]:
        """Go on under another rule, on another map or for another robot, from the next step on.

        `clock`: "keep" has the new rule's windows count from where those of the present one do, at first the
        session's start; "restart" from the next step. `pose` is x_t where the robot is by now; without it the
        service takes it to be where the last decision's action leads, and the step that follows tells.
        A main task that is over stays over: what is left to do then is the new rule.
        Raises InfeasibleSwitch where the new rule cannot be kept from there; nothing is changed then.
        """
        body = {**policies_asked(policy_id, policy_ids), "clock": clock}
        return (yield from self._ask(pose, lambda x_t: self._switched(x_t, body)))

    def _switched(self, x_t: Pose | None, body: Mapping[str, Any]) -> Flow[SessionInfo]:
        poses = self._with(x_t)
        reply = yield from self._send("switch", poses, self.t, {"t": self.t, **body})
        info = build(SessionInfo, wire.json_object(reply))
        self.info, self.spec_status, self.finished = info, info.spec_status, info.finished
        self._heard[:] = info.rules
        self._poses, self._continuation = poses, Continuation(info.margin)
        self._stored = max(self._stored, self.t + (x_t is not None))
        return info

    def _end(self, pose: Numbers | None = None) -> Flow[Verdict]:
        """End the session; `pose` is the state the last action led to."""
        return (yield from self._ask(pose, lambda x_t: self._close(x_t, TRIES)))

    def _close(self, x_t: Pose | None, tries: int) -> Flow[Verdict]:
        """With no pose at hand (a session read back, not stepped) it closes on what the server has."""
        yield Within(None)
        poses = self._with(x_t)
        reply = yield from self._send("close", poses, max(poses, default=self.t), {}, tries)
        verdict = build(Verdict, wire.json_object(reply))
        self.closed = self.finished = True
        self.spec_status = verdict.spec_status
        return verdict

    def _leave(self, error: BaseException | None) -> Flow[None]:
        """At the end of a block. An error of the block's own is what the caller must see: then one try,
        whatever comes of it.
        """
        if not self.closed:
            with contextlib.suppress(NotFound if error is None else SpecshieldError):
                yield from self._close(None, TRIES if error is None else 1)

    def _events(self, after: int | None) -> Events:
        def switched(rule: Mapping[str, Any]) -> None:
            same = itemgetter("from", "formula", "actions", "terminal_actions")
            if same(rule) not in map(same, self._heard):  # else it is one of those that were known before
                insort(self._heard, rule, key=itemgetter("from"))

        def decided(answer: Mapping[str, Any]) -> Decision:
            # Once the rule is settled, a session that is finished is one whose main task is over.
            then = under(self.info, self._heard, answer.get("t", 0))
            return decision_of(answer, then, bool(answer.get("finished")), {})

        return Events(self.id, self.t - 1 if after is None else after, decided, switched)

    def _trajectory(self) -> Flow[tuple[TrajectoryItem, ...]]:
        """The states x_0..x_t that the server has, and its answers."""
        body = yield from call(wire.get("sessions", self.id, "trajectory", slow=True))
        return tuple(build(TrajectoryItem, item) for item in build(Page, body).items)

    def _learned(self) -> Flow[Learned]:
        """The cells that the session found occupied or free though the map says otherwise."""
        return build(Learned, (yield from call(wire.get("sessions", self.id, "learned", slow=True))))

    def _save_record(self, path: str | os.PathLike[str]) -> Flow[str]:
        """Write the session's record to a file, for `specshield verify`; the answer is its seal.

        Who keeps the seal can tell later that a record shown to them is this one.
        """
        reply = yield from fetch(wire.get("sessions", self.id, "record", slow=True))
        Path(path).write_bytes(reply.content)
        return reply.headers.get("x-record-seal", "")

    step = deciding(_step)
    switch = stepping(_switch)
    trajectory = stepping(_trajectory)
    learned = stepping(_learned)
    save_record = stepping(_save_record)
    close = stepping(_end)

    def _with(self, x_t: Pose | None) -> dict[int, Pose]:
        """The poses known, and x_t where it is given."""
        return self._poses if x_t is None else {**self._poses, self.t: x_t}

    def _send(
        self, action: str, poses: Mapping[int, Pose], t: int, body: Mapping[str, Any], tries: int = TRIES
    ) -> Flow[Reply]:
        """Post the poses the server lacks up to x_t; on a gap once more, from where it says it stands. A pose
        that it took with a step whose answer was lost stands, whatever was recorded of that step since.
        """
        poses, start, gaps, joined = dict(poses), min(self._stored, t), 0, -1
        while True:
            known = {"t": t, "poses": [poses[i] for i in range(start, t + 1)]} if t in poses else {}
            sent = {**known, **body}
            step, slow = t if action == "steps" else None, action == "switch"
            request = wire.post("sessions", self.id, action, body=sent, slow=slow, tries=tries, t=step)
            reply = (yield from deliver(request)).reply
            try:
                wire.check(reply)
            except HistoryGap as gap:
                start, gaps = gap.details.get("expected_t", -1), gaps + 1
                if gaps > 1 or not isinstance(start, int) or not all(i in poses for i in range(start, t + 1)):
                    raise  # it lacks poses that this session, once read back, never had
            except HistoryConflict as conflict:
                start = conflict.details.get("t", -1)
                if not joined < start < self.t:
                    raise  # it is x_t that differs
                poses[start], joined = wire.pose_values(conflict.details["stored"]), start
                self._stored = max(self._stored, start + 1)
            else:
                return reply
