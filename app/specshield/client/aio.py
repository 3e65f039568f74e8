"""AsyncShieldClient: sync.py with `await`."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, Generic, Literal, Protocol, cast, overload

import httpx

from specshield.client import bounded, calls
from specshield.client.core import D, Feed, Flow, More, P, Resource, T, Wait, looks_like, page_of
from specshield.client.models import Decision, LocalDecision, Map, Policy, SessionInfo
from specshield.client.state import SessionState
from specshield.client.stream import AsyncStreams, packed
from specshield.client.transport import STALE, Exchange, address, check_open, headers
from specshield.client.wire import TRIES, Failure, Reply, Request
from specshield.errors import NotFound, SpecshieldError

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from specshield.client.models import Beginning


class Run(Protocol):
    async def __call__(self, flow: Flow[T], /) -> T: ...


def awaiting(flow: Callable[P, Flow[T]]) -> Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]:
    """The method of a client, or of a resource of its, that makes this call."""

    @looks_like(flow)
    async def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:
        made: T = await self._run(flow(*args, **kwargs))
        return made

    return method


class AsyncShieldClient:
    """`ShieldClient` for asyncio: `async with await client.sessions.create(...) as session`."""

    def __init__(
        self,
        base_url: str,
        api_key: str | None = None,
        timeout: float = 0.5,
        *,
        stream: bool = False,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._timeout = timeout
        url = address(base_url)
        self._http = httpx.AsyncClient(
            base_url=url, headers=headers(api_key), transport=transport or bounded.AsyncTransport(url)
        )
        self._streams = AsyncStreams(self._http) if stream else None
        self.specs = AsyncSpecs(self._run)
        self.maps = AsyncMaps(self._run)
        self.policies = AsyncPolicies(self._run)
        self.sessions = AsyncSessions(self._run)

    async def __aenter__(self) -> AsyncShieldClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    wait_until_ready = awaiting(calls.wait_until_ready)

    async def close(self) -> None:
        if self._streams is not None:
            self._streams.close()
        await self._http.aclose()

    async def _run(self, flow: Flow[T], /) -> T:
        began, ends, got = time.monotonic(), math.inf, cast(Any, None)
        try:
            while True:
                command, got = flow.send(got), None
                if isinstance(command, Request):
                    got = await self._perform(command, ends)
                elif isinstance(command, More):
                    got = await self._more(command)
                elif isinstance(command, Wait):
                    await asyncio.sleep(max(0.0, min(command.seconds, ends - time.monotonic())))
                else:
                    ends = command.ends(began, self._timeout)
        except StopIteration as stop:
            return cast(T, stop.value)

    async def _perform(self, request: Request, ends: float) -> Reply | Failure:
        check_open(self._http)
        exchange = Exchange(request, self._http.base_url, self._timeout, ends)
        if exchange.seconds <= 0.0:
            return exchange.failure(httpx.PoolTimeout(""))
        message = None if self._streams is None else packed(request)
        if self._streams is not None and message is not None:
            return await self._streams.perform(exchange, message)
        bounded.ENDS.set(exchange.ends)
        try:
            reply = await asyncio.wait_for(self._exchanged(exchange), exchange.ends - time.monotonic())
        except (asyncio.TimeoutError, TimeoutError):  # one and the same from Python 3.11 on
            return exchange.failure(httpx.ReadTimeout("the time of this try is over"))
        except httpx.RequestError as error:
            return exchange.failure(error)
        return exchange.failure(httpx.ReadError(STALE)) if reply is None else reply

    async def _exchanged(self, exchange: Exchange) -> Reply | None:
        async with contextlib.AsyncExitStack() as opened:
            response = await opened.enter_async_context(
                self._http.stream(**exchange.arguments(self._timeout))
            )
            exchange.begin(response)
            listens = exchange.request.listens and response.status_code == 200
            if not listens:
                async for chunk in response.aiter_bytes():
                    exchange.take(chunk)
            reply = exchange.reply(response)
            if reply is not None and listens:
                reply = replace(reply, feed=Feed(response.aiter_bytes(), opened.pop_all().aclose))
            elif reply is None and "network_stream" in response.extensions:
                await response.extensions["network_stream"].aclose()  # nothing more is read from it
            return reply

    async def _more(self, more: More) -> Reply:
        bounded.ENDS.set(more.ends)
        try:
            piece: bytes = await asyncio.wait_for(anext(more.feed.pieces, b""), more.ends - time.monotonic())
        except (asyncio.TimeoutError, TimeoutError, httpx.RequestError):
            piece = b""
        if not piece:
            await more.feed.close()
        return more.got(piece)


def awaiting_step(
    flow: Callable[Concatenate[AsyncSession[Any], P], Flow[T]],
) -> Callable[Concatenate[AsyncSession[Any], P], Coroutine[Any, Any, T]]:
    """The method of a session that makes this call, which is a method of its state."""

    @looks_like(flow)
    async def method(self: AsyncSession[Any], /, *args: P.args, **kwargs: P.kwargs) -> T:
        return await self._run(flow(self, *args, **kwargs))

    return method


def deciding(
    flow: Callable[Concatenate[AsyncSession[Any], P], Flow[Any]],
) -> Callable[Concatenate[AsyncSession[D], P], Coroutine[Any, Any, D]]:
    """As `awaiting_step`, of the call whose answer is what this session's steps give."""
    return awaiting_step(flow)


def opening(
    flow: Callable[P, Flow[SessionInfo]],
) -> Callable[Concatenate[Resource[Run], P], Coroutine[Any, Any, AsyncSession]]:
    """The method that makes this call and gives the session that it tells of."""

    @looks_like(flow)
    async def method(self: Resource[Run], /, *args: P.args, **kwargs: P.kwargs) -> AsyncSession:
        info, given = await self._run(flow(*args, **kwargs)), cast(dict[str, Any], kwargs)
        pose, on_failure = given.get("initial_pose"), given.get("on_failure", "raise")
        begun = AsyncSession[Any](self._run, info, pose, on_failure)
        await self._run(begun._recall())
        return begun

    return method


def pages(cls: type[T], resource: str) -> Callable[[Resource[Run]], AsyncIterator[T]]:
    """The method that lists all there are."""

    async def method(self: Resource[Run]) -> AsyncIterator[T]:
        """All of them, in the order of the server's pages."""
        page = await self._run(page_of(cls, resource, None))
        while True:
            for item in page.items:
                yield item
            if page.next is None:
                return
            page = await self._run(page_of(cls, resource, page.next))

    return method


class AsyncSession(SessionState, Generic[D]):
    """`Session` for asyncio."""

    _run: Run

    async def __aenter__(self) -> AsyncSession[D]:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.closed:
            return
        with contextlib.suppress(NotFound if error is None else SpecshieldError):
            await self._run(self._close(None, TRIES if error is None else 1))

    step = deciding(SessionState._step)
    switch = awaiting_step(SessionState._switch)
    trajectory = awaiting_step(SessionState._trajectory)
    save_record = awaiting_step(SessionState._save_record)
    close = awaiting_step(SessionState._end)

    async def events(self, after: int | None = None) -> AsyncIterator[Decision]:
        """As `Session.events`."""
        events = self._events(after)
        try:
            while (decision := await self._run(events.following())) is not None:
                yield decision
        finally:
            if events.feed is not None:
                await events.feed.close()


class AsyncSpecs(Resource[Run]):
    validate = awaiting(calls.validate)


class AsyncMaps(Resource[Run]):
    create = awaiting(calls.create_map)
    upload = awaiting(calls.upload_map)
    procthor = awaiting(calls.procthor_map)
    occupancy_grid = awaiting(calls.occupancy_grid_map)
    get = awaiting(calls.get_map)
    image = awaiting(calls.map_image)
    delete = awaiting(calls.delete_map)
    list = pages(Map, "maps")


class AsyncPolicies(Resource[Run]):
    create = awaiting(calls.create_policy)
    upload = awaiting(calls.upload_policy)
    get = awaiting(calls.get_policy)
    image = awaiting(calls.policy_image)
    delete = awaiting(calls.delete_policy)
    wait = awaiting(calls.wait_policy)
    list = pages(Policy, "policies")


class AsyncSessions(Resource[Run]):
    if TYPE_CHECKING:

        @overload
        def create(
            self, *, on_failure: Literal["raise"] = "raise", **options: Unpack[Beginning]
        ) -> Coroutine[Any, Any, AsyncSession[Decision]]: ...
        @overload
        def create(
            self, *, on_failure: Literal["witness", "stop"], **options: Unpack[Beginning]
        ) -> Coroutine[Any, Any, AsyncSession[Decision | LocalDecision]]: ...
        def create(self, **options: Any) -> Any: ...

        @overload
        def get(
            self, id: str, *, on_failure: Literal["raise"] = "raise"
        ) -> Coroutine[Any, Any, AsyncSession[Decision]]: ...
        @overload
        def get(
            self, id: str, *, on_failure: Literal["witness", "stop"]
        ) -> Coroutine[Any, Any, AsyncSession[Decision | LocalDecision]]: ...
        def get(self, id: str, **options: Any) -> Any: ...
    else:
        create = opening(calls.create_session)
        get = opening(calls.get_session)
    delete = awaiting(calls.delete_session)
    list = pages(SessionInfo, "sessions")
