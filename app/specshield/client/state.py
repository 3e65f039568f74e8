"""The state of a session on the caller's side: its next step, the poses that the server has, its verdict."""

from __future__ import annotations

import contextlib
import os
from bisect import insort
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import Any, Literal

from specshield.client import wire
from specshield.client.away import RECALLED, Branch, Circuit, Continuation, OnFailure, is_away, is_taken
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
)
from specshield.client.resources import deciding, stepping
from specshield.client.wire import TRIES, Logits, Numbers, Points, Reply
from specshield.client.wiring import Wiring
from specshield.errors import HistoryConflict, HistoryGap, NotFound, SessionFinished, SpecshieldError


class SessionState:
    """What `Session` and `AsyncSession` share: everything but the I/O.

    `t` is the next step. A `step` that raises changes nothing, so it may be called again with the same pose
    and logits. Or call `record` with the pose and go on: the next step that reaches the server sends it too.
    """

    def __init__(
        self,
        run: Any,
        info: SessionInfo,
        initial_pose: Numbers | None = None,
        on_failure: OnFailure = "raise",
    ) -> None:
        """run: the client's function that performs a call."""
        self._run = run
        self.info = info
        self.on_failure = on_failure
        self.t = info.next_t
        self.spec_status: SpecStatus = info.spec_status
        self.finished = info.finished
        self.main_task_done = info.main_task_done
        self.closed = False
        self._heard = list(info.rules)  # the rules, also those of which only `events` has told
        self._stored = info.next_t  # the number of poses that the server has, as far as is known
        self._poses: dict[int, Pose] = {} if initial_pose is None else {0: wire.pose_values(initial_pose)}
        self._continuation = Continuation(info.margin)
        self._circuit = Circuit()
        self._wiring = Wiring(info.id)
        # The step for which the service may have an x_t without our knowing: it was sent without an answer,
        # by a former user of the session, or with a switch. -1: there is none.
        self._unanswered = info.next_t if initial_pose is None else -1

    def __repr__(self) -> str:
        over = "over" if self.finished else f"next step {self.t}"
        return f"<{type(self).__name__} {self.id}: {over}, the rule is {self.spec_status}>"

    @property
    def id(self) -> str:
        return self.info.id

    def rule_at(self, t: int) -> str:
        """The rule that decides step t, as far as this object and its `events` know."""
        return str(self._rule(t)["formula"])

    def _rule(self, t: int) -> Mapping[str, Any]:
        """The rule that decides step t, by the contract's names; the session's only one if it is not told."""
        only = {**vars(self.info), "formula": self.info.spec["formula"]}
        return next((rule for rule in reversed(self._heard) if rule["from"] <= t), only)

    @property
    def unsent(self) -> dict[int, Pose]:
        """The poses that the service has not confirmed, by step. `record` them again after a restart."""
        return {t: pose for t, pose in self._poses.items() if self._stored <= t < self.t}

    def record(self, pose: Numbers) -> None:
        """Note the pose of step t, which got no decision because the service was away; go on to step t + 1.

        If it is on the certified continuation, the robot is taken to run the continuation's next action.
        Raises SessionFinished for a session that was closed.
        """
        if self.closed:
            raise SessionFinished("the session is closed", path="t", got=self.t, expected="a new session")
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
        """Decide step t from the pose (x, y, theta) and one logit for each action; run `decision.execute`.

        `main_task_done`: leave it None if you run `decision.execute`; the session then remembers a drawn
        terminal action. If you draw from `decision.distribution` yourself, say True or False. Once it is
        true, `logits` may be None. `deadline` [s] is a hard limit on the whole call, retries included,
        whatever the server does; by default it is five timeouts of the client. `occupied` and `free` are
        points (x, y) in the map frame at which the robot's sensors see an obstacle or free floor now. With
        `explain` the decision says of each forbidden action what it would break. An error leaves the session
        at t: call again with the same pose and logits, or `record` the pose and go on. With `on_failure`
        "witness" or "stop" only errors of the caller are raised; if the service cannot answer, a
        `LocalDecision` says what to do. A `main_task_done` of True is remembered; signals are lost. While the
        service is known to be away, it is asked with a single try, at pauses of 0.25 to 4 s; steps in between
        return at once, also those that say to stop: a standing robot asks again at its own pace.
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
            return (yield from self._ask(x_t, lambda x_t: self._decided(x_t, body, own, TRIES)))
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
        """The decision that follows the certified continuation at this step."""
        t, self.main_task_done = self.t, over
        self.record(x_t)
        reason = "the service cannot answer; the certified continuation is followed"
        leads = next((branch.pose for branch in self._continuation.branches), None)
        return LocalDecision(
            t, "witness", way.plan[0], reason, self.spec_status, way.plan[1:], leads, error=error
        )

    def _ask(self, pose: Numbers | None, asking: Callable[[Pose | None], Flow[T]]) -> Flow[T]:
        """The result of `asking` for step t. If the service took this step before, with another pose or other
        logits, and its answer was lost, the step is passed over: the robot stood, so its pose is that of the
        next step.
        """
        x_t = None if pose is None else wire.pose_values(pose)
        asked, raises = self._unanswered, self.on_failure == "raise"
        if not raises:
            self._unanswered = self.t  # until an answer comes: the step may be cancelled
        try:
            return (yield from asking(x_t))
        except SpecshieldError as error:
            if not is_away(error):
                self._unanswered = asked
            taken = is_taken(error, self.t)
            if taken and raises:
                instead = "or session.record(pose), to go on without a decision for this step"
                error.expected = f"{error.expected or 'a later step'}; {instead}"
            if raises or not taken or asked != self.t or x_t is None:
                raise
        self.record(x_t)
        self._stored = max(self._stored, self.t)
        return (yield from self._ask(x_t, asking))

    def _decided(self, x_t: Pose | None, body: Mapping[str, Any], own: bool, tries: int) -> Flow[Decision]:
        t, over, poses = self.t, body["main_task_done"], self._with(x_t)
        reply = yield from self._send("steps", poses, t, body, tries)
        decision = decision_of(wire.json_object(reply), vars(self.info), over, wire.timings(reply))
        self._poses, self._stored, self.t, self._unanswered = poses, t + 1, t + 1, -1
        self.spec_status = decision.spec_status
        ends = own and decision.action in self.info.terminal_actions
        self.main_task_done = over or ends
        self.finished = decision.finished or (ends and decision.spec_status != "pending")
        if self.on_failure == "witness":
            self._continuation.learn(decision, poses[t])
        self._wiring.note(t, poses[t], decision, executed=own)
        return decision

    def _recall(self) -> Flow[None]:
        """Reads the certified continuation from the stored answers, after the robot's process began anew."""
        if self.on_failure != "witness" or self.finished:
            return
        for item in (yield from self._trajectory(max(self.t - 1 - RECALLED, -1))) if self.t else ():
            self._continuation.branches = ()
            if item.decision is not None and item.rule == max(0, len(self.info.rules) - 1):
                decision = decision_of(item.decision, vars(self.info), self.info.main_task_done, {})
                self._continuation.learn(decision, item.pose)

    def _switch(
        self,
        policy_id: str | None = None,
        policy_ids: Sequence[str] | None = None,
        *,
        clock: Literal["keep", "restart"] = "keep",
        pose: Numbers | None = None,
    ) -> Flow[SessionInfo]:
        """Go on under another rule, on another map or with another robot, from the next step on.

        `clock`: with "keep" the new rule's windows count from the same step as the present rule's, at first
        the session's start; with "restart" from the next step. `pose` is where the robot is now; without it
        the service takes the robot to be where the last decision's action leads, until the next step says
        where it is. A main task that is over stays over: the robot then only has to keep the new rule. Raises
        InfeasibleSwitch if no way to keep the new rule was found; nothing is changed then.
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
        self._wiring = Wiring(self.id, self._wiring.said)
        self._stored = max(self._stored, self.t + (x_t is not None))
        return info

    def _end(self, pose: Numbers | None = None) -> Flow[Verdict]:
        """End the session; `pose` is the state to which the last action led."""
        return (yield from self._ask(pose, lambda x_t: self._close(x_t, TRIES)))

    def _close(self, x_t: Pose | None, tries: int) -> Flow[Verdict]:
        """Closes the session, without a pose (as after reading it back) on the poses that the server has."""
        yield Within(None)
        poses = self._with(x_t)
        reply = yield from self._send("close", poses, max(poses, default=self.t), {}, tries)
        verdict = build(Verdict, wire.json_object(reply))
        self.closed = self.finished = True
        self.spec_status = verdict.spec_status
        return verdict

    def _leave(self, error: BaseException | None) -> Flow[None]:
        """Closes the session at the end of a `with` block. After an error in the block, which the caller has
        to see, there is one try, and its own error is ignored.
        """
        if not self.closed:
            with contextlib.suppress(NotFound if error is None else SpecshieldError):
                yield from self._close(None, TRIES if error is None else 1)

    def _events(self, after: int | None) -> Events:
        def switched(rule: Mapping[str, Any]) -> None:
            same = itemgetter("from", "formula", "actions", "terminal_actions")
            if same(rule) not in map(same, self._heard):  # else the rule was known before
                insort(self._heard, rule, key=itemgetter("from"))

        def decided(answer: Mapping[str, Any]) -> Decision:
            # Once the rule is settled, a session is finished exactly if its main task is over.
            return decision_of(answer, self._rule(answer.get("t", 0)), bool(answer.get("finished")), {})

        return Events(self.id, self.t - 1 if after is None else after, decided, switched)

    def _trajectory(self, after: int = -1) -> Flow[tuple[TrajectoryItem, ...]]:
        """The states that the server has after step `after`, with its answers."""
        asked = wire.get("sessions", self.id, "trajectory", slow=True, params={"after": str(after)})
        body = yield from call(asked)
        return tuple(build(TrajectoryItem, item) for item in build(Page, body).items)

    def _learned(self) -> Flow[Learned]:
        """The cells that the session found occupied or free, unlike the map."""
        return build(Learned, (yield from call(wire.get("sessions", self.id, "learned", slow=True))))

    def _save_record(self, path: str | os.PathLike[str]) -> Flow[str]:
        """Write the session's record to a file, for `specshield verify`, and return its seal.

        With the seal you can check later that a record is this one.
        """
        reply = yield from fetch(wire.get("sessions", self.id, "record", slow=True))
        wire.write_file(path, reply.content)
        return reply.headers.get("x-record-seal", "")

    step = deciding(_step)
    switch = stepping(_switch)
    trajectory = stepping(_trajectory)
    learned = stepping(_learned)
    save_record = stepping(_save_record)
    close = stepping(_end)

    def _with(self, x_t: Pose | None) -> dict[int, Pose]:
        """The known poses, with x_t if it is given."""
        return self._poses if x_t is None else {**self._poses, self.t: x_t}

    def _send(
        self, action: str, poses: Mapping[int, Pose], t: int, body: Mapping[str, Any], tries: int = TRIES
    ) -> Flow[Reply]:
        """Sends the poses that the server lacks up to x_t; after a gap once more, from the pose that the
        server names. If the server has taken another pose with a step whose answer was lost, the server's
        pose counts.
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
                    raise  # the server lacks poses that this object does not have either
            except HistoryConflict as conflict:
                start = conflict.details.get("t", -1)
                if not joined < start < self.t:
                    raise  # x_t itself differs
                poses[start], joined = wire.pose_values(conflict.details["stored"]), start
                self._stored = max(self._stored, start + 1)
            else:
                return reply
