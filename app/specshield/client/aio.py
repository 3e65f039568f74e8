"""AsyncShieldClient: the same as sync.py, for asyncio."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any, Generic, cast

import httpx

from specshield.client import calls
from specshield.client.core import D, Feed, Flow, More, T, Wait, page_of
from specshield.client.models import Decision, Page
from specshield.client.network import bounded
from specshield.client.network.stream import AsyncStreams, packed
from specshield.client.network.transport import LATE, Exchange, address, headers
from specshield.client.resources import Maps, Policies, Sessions, Specs, performing
from specshield.client.state import SessionState
from specshield.client.wire import Failure, Reply, Request, seconds_value


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
        self._timeout = seconds_value(timeout, "timeout")
        url = address(base_url)
        self._http = httpx.AsyncClient(
            base_url=url, headers=headers(api_key), transport=transport or bounded.AsyncTransport(url)
        )
        self._streams = AsyncStreams(self._http) if stream else None
        self.specs, self.maps = Specs(self), Maps(self)
        self.policies, self.sessions = Policies(self), Sessions(self)
        self._session = AsyncSession  # the class of what `sessions` returns

    async def __aenter__(self) -> AsyncShieldClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    wait_until_ready = performing(calls.wait_until_ready)

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
        exchange = Exchange(request, self._http, self._timeout, ends)
        if exchange.seconds <= 0.0:
            return exchange.failure(httpx.PoolTimeout(""))
        if self._streams is not None:
            if (message := packed(request)) is not None:
                return await self._streams.perform(exchange, message)
            self._streams.end(request)
        bounded.ENDS.set(exchange.ends)
        try:
            return await asyncio.wait_for(self._exchanged(exchange), exchange.ends - time.monotonic())
        except (*LATE, httpx.RequestError) as error:
            return exchange.failure(error)

    async def _exchanged(self, exchange: Exchange) -> Reply | Failure:
        async with contextlib.AsyncExitStack() as opened:
            response = await opened.enter_async_context(
                self._http.stream(**exchange.arguments(self._timeout))
            )
            exchange.begin(response)
            listens = exchange.request.listens and response.status_code == 200
            if not listens:
                async for chunk in response.aiter_bytes():
                    exchange.take(chunk)
            reply = exchange.reply(response.status_code, response.headers)
            if isinstance(reply, Failure) and "network_stream" in response.extensions:
                await response.extensions["network_stream"].aclose()  # what still comes is never read
            elif isinstance(reply, Reply) and listens:
                reply = replace(reply, feed=Feed(response.aiter_bytes(), opened.pop_all().aclose))
            return reply

    async def _more(self, more: More) -> Reply:
        bounded.ENDS.set(more.ends)
        try:
            piece: bytes = await asyncio.wait_for(anext(more.feed.pieces, b""), more.ends - time.monotonic())
        except (*LATE, httpx.RequestError):
            piece = b""
        if not piece:
            await more.feed.close()
        return more.got(piece)

    async def _listed(self, cls: type[T], resource: str) -> AsyncIterator[T]:
        page: Page[T] | None = None
        while page is None or page.next is not None:
            page = await self._run(page_of(cls, resource, None if page is None else page.next))
            for item in page.items:
                yield item


class AsyncSession(SessionState, Generic[D]):
    """`Session` for asyncio."""

    async def __aenter__(self) -> AsyncSession[D]:
        return self

    async def __aexit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        await self._run(self._leave(error))

    async def events(self, after: int | None = None) -> AsyncIterator[Decision]:
        """The same as `Session.events`."""
        events = self._events(after)
        try:
            while (decision := await self._run(events.following())) is not None:
                yield decision
        finally:
            if events.feed is not None:
                await events.feed.close()
