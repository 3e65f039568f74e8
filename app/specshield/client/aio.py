"""AsyncShieldClient: sync.py with `await`; what each call does is said there."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
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
    async def __call__(self, flow: Flow[T], /) -> T: ...


class AsyncShieldClient:
    """`ShieldClient` for asyncio: `async with await client.sessions.create(...) as session`."""

    def __init__(
        self,
        base_url: str,
        api_key: str | None = None,
        timeout: float = 0.5,
        *,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._timeout = timeout
        self._http = httpx.AsyncClient(
            base_url=address(base_url), headers=headers(api_key), transport=transport
        )
        self.specs = AsyncSpecs(self._run)
        self.maps = AsyncMaps(self._run)
        self.policies = AsyncPolicies(self._run)
        self.sessions = AsyncSessions(self._run)

    async def __aenter__(self) -> AsyncShieldClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        await self._http.aclose()

    async def _run(self, flow: Flow[T], /) -> T:
        try:
            command = next(flow)
            while True:
                if isinstance(command, Wait):
                    await asyncio.sleep(command.seconds)
                    command = next(flow)
                else:
                    command = flow.send(await self._perform(command))
        except StopIteration as stop:
            return cast(T, stop.value)

    async def _perform(self, request: Request) -> Reply | Failure:
        check_open(self._http)
        start, limit = time.monotonic(), allowed(request, self._timeout)
        try:
            response = await self._http.request(**arguments(request, self._timeout))
        except httpx.RequestError as error:
            return failure(error, request, self._http.base_url, time.monotonic() - start, limit)
        return reply(response, time.monotonic() - start, limit)


class AsyncSpecs:
    def __init__(self, run: Run) -> None:
        self._run = run

    async def validate(
        self,
        formula: str,
        regions: Mapping[str, Any] | None = None,
        *,
        signals: Mapping[str, float] | None = None,
        map_id: str | None = None,
    ) -> Spec:
        return await self._run(core.validate(formula, regions, signals, map_id))


class AsyncMaps:
    def __init__(self, run: Run) -> None:
        self._run = run

    async def upload(self, metadata: Content, image: Content) -> Map:
        return await self._run(core.upload_map(metadata, image))

    async def procthor(
        self, house: Mapping[str, Any], asset_sizes: Mapping[str, Any], resolution: float = 0.05
    ) -> Map:
        return await self._run(
            core.post_map(format="procthor", house=house, asset_sizes=asset_sizes, resolution=resolution)
        )

    async def occupancy_grid(self, info: Mapping[str, Any], data: Sequence[int]) -> Map:
        return await self._run(core.post_map(format="occupancy_grid", info=info, data=data))

    def list(self) -> AsyncIterator[Map]:
        return _pages(self._run, Map, "maps")

    async def get(self, id: str) -> Map:
        return await self._run(core.get_map(id))

    async def image(self, id: str) -> bytes:
        return await self._run(core.map_image(id))


class AsyncPolicies:
    def __init__(self, run: Run) -> None:
        self._run = run

    async def create(
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
        return await self._run(
            core.create_policy(map_id, formula, regions, signals, robot, method, seed, options)
        )

    async def upload(self, weights: Content, card: Content | Mapping[str, Any]) -> Policy:
        return await self._run(core.upload_policy(weights, card))

    def list(self) -> AsyncIterator[Policy]:
        return _pages(self._run, Policy, "policies")

    async def get(self, id: str) -> Policy:
        return await self._run(core.get_policy(id))

    async def delete(self, id: str) -> None:
        return await self._run(core.delete_policy(id))

    async def wait(
        self,
        id: str,
        *,
        timeout: float = 3600.0,
        interval: float = 1.0,
        progress: Callable[[Policy], object] | None = None,
    ) -> Policy:
        return await self._run(core.wait_policy(id, timeout, interval, progress))


class AsyncSession(SessionState):
    """`Session` for asyncio."""

    def __init__(self, run: Run, info: SessionInfo, initial_pose: Numbers | None = None) -> None:
        super().__init__(info, initial_pose)
        self._run = run

    async def __aenter__(self) -> AsyncSession:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.closed:
            return
        with contextlib.suppress(NotFound if error is None else SpecshieldError):
            await self._run(self._close(None, TRIES if error is None else 1))

    async def step(
        self,
        pose: Numbers,
        logits: Logits | None = None,
        *,
        main_task_done: bool | None = None,
        signals: Mapping[str, float] | None = None,
        witnesses: bool = False,
    ) -> Decision:
        return await self._run(self._step(pose, logits, main_task_done, signals, witnesses))

    async def trajectory(self) -> tuple[TrajectoryItem, ...]:
        return await self._run(self._trajectory())

    async def close(self, pose: Numbers | None = None) -> Verdict:
        return await self._run(self._close(pose, TRIES))


class AsyncSessions:
    def __init__(self, run: Run) -> None:
        self._run = run

    async def create(
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
    ) -> AsyncSession:
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
        return AsyncSession(self._run, await self._run(flow), initial_pose)

    async def get(self, id: str) -> AsyncSession:
        return AsyncSession(self._run, await self._run(core.get_session(id)))

    def list(self) -> AsyncIterator[SessionInfo]:
        return _pages(self._run, SessionInfo, "sessions")

    async def delete(self, id: str) -> None:
        return await self._run(core.delete_session(id))


async def _pages(run: Run, cls: type[T], resource: str) -> AsyncIterator[T]:
    page = await run(core.page(cls, resource, None))
    while True:
        for item in page.items:
            yield item
        if page.next is None:
            return
        page = await run(core.page(cls, resource, page.next))
