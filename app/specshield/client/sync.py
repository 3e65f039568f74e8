"""ShieldClient: the shell that performs the core's requests with httpx and time.sleep."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Literal, Protocol, TypeVar, cast

import httpx

from specshield.client import core
from specshield.client.core import Flow, Wait
from specshield.client.models import Decision, Map, Policy, SessionInfo, Spec, TrajectoryItem, Verdict
from specshield.client.state import SessionState
from specshield.client.transport import address, allowed, arguments, check_open, failure, headers, reply
from specshield.client.wire import TRIES, Content, Failure, Logits, Numbers, Reply, Request
from specshield.errors import NotFound, SpecshieldError

T = TypeVar("T")


class Run(Protocol):
    def __call__(self, flow: Flow[T], /) -> T: ...


class ShieldClient:
    """The service at `base_url`.

    `timeout` [s] is what a decision may take, one try; what prepares something (a map, a policy, a
    session) gets at least 30 s. Lost answers are asked for again (see `core`), so a call returns or
    raises within five timeouts. Every error is a `SpecshieldError`; no answer is a `TransportError`.
    """

    def __init__(
        self,
        base_url: str,
        api_key: str | None = None,
        timeout: float = 0.5,
        *,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self._timeout = timeout
        self._http = httpx.Client(base_url=address(base_url), headers=headers(api_key), transport=transport)
        self.specs = Specs(self._run)
        self.maps = Maps(self._run)
        self.policies = Policies(self._run)
        self.sessions = Sessions(self._run)

    def __enter__(self) -> ShieldClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    def _run(self, flow: Flow[T], /) -> T:
        try:
            command = next(flow)
            while True:
                if isinstance(command, Wait):
                    time.sleep(command.seconds)
                    command = next(flow)
                else:
                    command = flow.send(self._perform(command))
        except StopIteration as stop:
            return cast(T, stop.value)

    def _perform(self, request: Request) -> Reply | Failure:
        check_open(self._http)
        start, limit = time.monotonic(), allowed(request, self._timeout)
        try:
            response = self._http.request(**arguments(request, self._timeout))
        except httpx.RequestError as error:
            return failure(error, request, self._http.base_url, time.monotonic() - start, limit)
        return reply(response, time.monotonic() - start, limit)


class Specs:
    def __init__(self, run: Run) -> None:
        self._run = run

    def validate(
        self,
        formula: str,
        regions: Mapping[str, Any] | None = None,
        *,
        signals: Mapping[str, float] | None = None,
        map_id: str | None = None,
    ) -> Spec:
        """Parse a formula; FormulaError says where it is wrong.

        Once regions, signals or a map (whose rooms are names) are given, every name must be one of theirs.
        """
        return self._run(core.validate(formula, regions, signals, map_id))


class Maps:
    def __init__(self, run: Run) -> None:
        self._run = run

    def upload(self, metadata: Content, image: Content) -> Map:
        """A ROS map_server map: YAML and PGM or PNG, each its content or the path object of a file."""
        return self._run(core.upload_map(metadata, image))

    def procthor(
        self, house: Mapping[str, Any], asset_sizes: Mapping[str, Any], resolution: float = 0.05
    ) -> Map:
        """A ProcTHOR house, drawn at `resolution` [m]; map (x, y) is house (x, z)."""
        return self._run(
            core.post_map(format="procthor", house=house, asset_sizes=asset_sizes, resolution=resolution)
        )

    def occupancy_grid(self, info: Mapping[str, Any], data: Sequence[int]) -> Map:
        """A nav_msgs/OccupancyGrid: its `info`, and `data` row by row from the lowest y."""
        return self._run(core.post_map(format="occupancy_grid", info=info, data=data))

    def list(self) -> Iterator[Map]:
        return _pages(self._run, Map, "maps")

    def get(self, id: str) -> Map:
        return self._run(core.get_map(id))

    def image(self, id: str) -> bytes:
        """The map as PNG."""
        return self._run(core.map_image(id))


class Policies:
    def __init__(self, run: Run) -> None:
        self._run = run

    def create(
        self,
        map_id: str,
        formula: str,
        regions: Mapping[str, Any] | None = None,
        *,
        signals: Mapping[str, float] | None = None,
        robot: str | Mapping[str, Any] = "stretch",
        method: Literal["dqn", "planner", "reachability"] = "reachability",
        seed: int = 0,
        options: Mapping[str, Any] | None = None,
    ) -> Policy:
        """Have a policy made; returns at once (see `wait`). The same request again is the same policy.

        `signals` names the other signals of the formula, with the value each holds before its first sample.
        """
        return self._run(core.create_policy(map_id, formula, regions, signals, robot, method, seed, options))

    def upload(self, weights: Content, card: Content | Mapping[str, Any]) -> Policy:
        """A policy trained elsewhere: safetensors and its card, each the content or a path object."""
        return self._run(core.upload_policy(weights, card))

    def list(self) -> Iterator[Policy]:
        return _pages(self._run, Policy, "policies")

    def get(self, id: str) -> Policy:
        return self._run(core.get_policy(id))

    def delete(self, id: str) -> None:
        """Cancel its training, or remove it. InUse while sessions use it."""
        return self._run(core.delete_policy(id))

    def wait(
        self,
        id: str,
        *,
        timeout: float = 3600.0,
        interval: float = 1.0,
        progress: Callable[[Policy], object] | None = None,
    ) -> Policy:
        """Ask every `interval` [s] until it is `ready` or `failed`; `progress` sees every answer.

        TransportTimeout after `timeout` [s]; the training goes on.
        """
        return self._run(core.wait_policy(id, timeout, interval, progress))


class Session(SessionState):
    """A session; as a context manager it is closed at the end, and its trajectory stays."""

    def __init__(self, run: Run, info: SessionInfo, initial_pose: Numbers | None = None) -> None:
        super().__init__(info, initial_pose)
        self._run = run

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.closed:
            return
        # An error of the block's own is what the caller must see: then one try, whatever comes of it.
        with contextlib.suppress(NotFound if error is None else SpecshieldError):
            self._run(self._close(None, TRIES if error is None else 1))

    def step(
        self,
        pose: Numbers,
        logits: Logits | None = None,
        *,
        main_task_done: bool | None = None,
        signals: Mapping[str, float] | None = None,
        witnesses: bool = False,
    ) -> Decision:
        """Decide step t from x_t = (x, y, theta) and one logit an action; run `decision.execute`.

        `main_task_done`: leave it None to run `decision.execute`; the session then remembers a drawn
        terminal action. A caller that draws from `decision.distribution` itself says True or False.
        `logits` may be None once it is true. Raises whatever went wrong and stays at t: call again
        with the same pose and logits, or `record` the pose and move on.
        """
        return self._run(self._step(pose, logits, main_task_done, signals, witnesses))

    def trajectory(self) -> tuple[TrajectoryItem, ...]:
        """The states x_0..x_t that the server has, and its answers."""
        return self._run(self._trajectory())

    def close(self, pose: Numbers | None = None) -> Verdict:
        """End the session; `pose` is the state the last action led to."""
        return self._run(self._close(pose, TRIES))


class Sessions:
    def __init__(self, run: Run) -> None:
        self._run = run

    def create(
        self,
        *,
        initial_pose: Numbers,
        policy_id: str | None = None,
        policy_ids: Sequence[str] | None = None,
        id: str | None = None,
        seed: int = 0,
        threshold: float = 1.0,
        margin: float = 0.0,
        slack: int = 0,
        evaluation: Literal["feasibility", "robustness"] = "feasibility",
        shaping: Literal["projection", "lookahead"] = "projection",
        max_steps: int | None = None,
        allow_infeasible: bool = False,
    ) -> Session:
        """Begin at `initial_pose`, which is x_0: the first step's pose has to agree with it to 1e-6.

        `threshold` is delta; the guarantee is for 1 with evaluation "feasibility", the defaults. With
        "robustness" it is the mean robustness [m] asked for, of which 1 is often too much. `margin` and
        `slack` are the robustness [m] and the steps to keep in hand.
        InfeasibleStart where no action has a satisfying future, unless `allow_infeasible`.
        """
        flow = core.create_session(
            policy_id,
            policy_ids,
            initial_pose,
            id=id,
            seed=seed,
            threshold=threshold,
            margin=margin,
            slack=slack,
            evaluation=evaluation,
            shaping=shaping,
            max_steps=max_steps,
            allow_infeasible=allow_infeasible,
        )
        return Session(self._run, self._run(flow), initial_pose)

    def get(self, id: str) -> Session:
        """A session begun earlier, ready for its next step.

        If the last action run was a terminal one, say `main_task_done=True` there: only the caller knows.
        """
        return Session(self._run, self._run(core.get_session(id)))

    def list(self) -> Iterator[SessionInfo]:
        return _pages(self._run, SessionInfo, "sessions")

    def delete(self, id: str) -> None:
        """Erase it with its trajectory."""
        return self._run(core.delete_session(id))


def _pages(run: Run, cls: type[T], resource: str) -> Iterator[T]:
    page = run(core.page(cls, resource, None))
    while True:
        yield from page.items
        if page.next is None:
            return
        page = run(core.page(cls, resource, page.next))
