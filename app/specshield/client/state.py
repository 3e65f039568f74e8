"""A session as its caller sees it: which step is next, which poses the server has, what is over."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from specshield.client.core import Flow, Within, call, deliver
from specshield.client.models import (
    Decision,
    Page,
    Pose,
    Residual,
    SessionInfo,
    SpecStatus,
    TrajectoryItem,
    Verdict,
    build,
)
from specshield.client.wire import (
    TRIES,
    Logits,
    Numbers,
    Reply,
    check,
    deadline_value,
    get,
    json_object,
    logit_values,
    pose_values,
    post,
    signal_values,
    timings,
)
from specshield.errors import HistoryGap


class SessionState:
    """What `Session` and `AsyncSession` share: all of it but the I/O.

    `t` is the next step. A `step` that raises leaves everything as it was, so it may be called again
    with the same pose and logits; or `record` takes the pose and moves on, and the next step that
    reaches the server delivers it.
    """

    def __init__(self, info: SessionInfo, initial_pose: Numbers | None = None) -> None:
        self.info = info
        self.t = info.next_t
        self.spec_status: SpecStatus = info.spec_status
        self.finished = info.finished
        self.main_task_done = info.main_task_done
        self.closed = False
        self._stored = info.next_t  # poses the server has, as far as is known
        self._poses: dict[int, Pose] = {} if initial_pose is None else {0: pose_values(initial_pose)}

    @property
    def id(self) -> str:
        return self.info.id

    def record(self, pose: Numbers) -> None:
        """Note x_t of a step that goes without a decision (the service was away), and move on to t + 1."""
        self._poses[self.t] = pose_values(pose)
        self.t += 1

    def _step(
        self,
        pose: Numbers,
        logits: Logits | None = None,
        *,
        main_task_done: bool | None = None,
        signals: Mapping[str, float] | None = None,
        witnesses: bool = False,
        deadline: float | None = None,
    ) -> Flow[Decision]:
        """Decide step t from x_t = (x, y, theta) and one logit an action; run `decision.execute`.

        `main_task_done`: leave it None to run `decision.execute`; the session then remembers a drawn
        terminal action. A caller that draws from `decision.distribution` itself says True or False.
        `logits` may be None once it is true. `deadline` [s] is a hard limit on the whole call, retries
        included, whatever the server does; without one it is five timeouts of the client.
        Raises whatever went wrong and stays at t: call again with the same pose and logits, or `record`
        the pose and move on.
        """
        yield Within(None if deadline is None else deadline_value(deadline))
        t, own = self.t, main_task_done is None
        over = self.main_task_done if main_task_done is None else main_task_done
        body: dict[str, Any] = {
            "logits": None if logits is None else logit_values(logits),
            "main_task_done": over,
            "witnesses": witnesses,
        }
        if signals is not None:
            body["signals"] = signal_values(signals)
        poses = {**self._poses, t: pose_values(pose)}
        reply = yield from self._send("steps", poses, t, body)

        decision = _decision(reply, self.info.terminal_actions, over)
        self._poses, self._stored, self.t = poses, t + 1, t + 1
        self.spec_status = decision.spec_status
        ends = own and decision.action in self.info.terminal_actions
        self.main_task_done = over or ends
        self.finished = decision.finished or (ends and decision.spec_status != "pending")
        return decision

    def _end(self, pose: Numbers | None = None) -> Flow[Verdict]:
        """End the session; `pose` is the state the last action led to."""
        return (yield from self._close(pose, TRIES))

    def _close(self, pose: Numbers | None, tries: int) -> Flow[Verdict]:
        """With no pose at hand (a session read back, not stepped) it closes on what the server has."""
        yield Within(None)
        poses = self._poses if pose is None else {**self._poses, self.t: pose_values(pose)}
        if poses:
            reply = yield from self._send("close", poses, max(poses), {}, tries)
        else:
            reply = (yield from deliver(post("sessions", self.id, "close", body={}, tries=tries))).reply
        verdict = build(Verdict, json_object(reply))
        self.closed = self.finished = True
        self.spec_status = verdict.spec_status
        return verdict

    def _trajectory(self) -> Flow[tuple[TrajectoryItem, ...]]:
        """The states x_0..x_t that the server has, and its answers."""
        body = yield from call(get("sessions", self.id, "trajectory", slow=True))
        raw: Page[Any] = build(Page, body)
        return tuple(build(TrajectoryItem, item) for item in raw.items)

    def _send(
        self, action: str, poses: Mapping[int, Pose], t: int, body: Mapping[str, Any], tries: int = TRIES
    ) -> Flow[Reply]:
        """Post the poses the server lacks up to x_t; on a gap once more, from where it says it stands."""

        def since(start: int) -> Flow[Reply]:
            newest = [poses[i] for i in range(start, t + 1)]
            request = post(
                "sessions",
                self.id,
                action,
                body={"t": t, "poses": newest, **body},
                tries=tries,
                t=t if action == "steps" else None,
            )
            reply = (yield from deliver(request)).reply
            check(reply)
            return reply

        try:
            return (yield from since(min(self._stored, t)))
        except HistoryGap as gap:
            start = gap.details.get("expected_t")
            if not isinstance(start, int) or not all(i in poses for i in range(start, t)):
                raise  # it lacks poses that this session, once read back, never had
        return (yield from since(start))


def _decision(reply: Reply, terminal: tuple[int, ...], over: bool) -> Decision:
    body = json_object(reply)
    residual = body.get("residual")
    return build(
        Decision,
        body,
        residual=None if residual is None else build(Residual, residual),
        timings=timings(reply),
        execute=_execute(body, terminal, over),
    )


def _execute(body: Mapping[str, Any], terminal: tuple[int, ...], over: bool) -> Any:
    """The action to run; see `Decision`."""
    action, pending = body.get("action"), body.get("spec_status") == "pending"
    if pending:
        return body.get("completion_action") if action in terminal else action
    return terminal[0] if over and terminal else action
