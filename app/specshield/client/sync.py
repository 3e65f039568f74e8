"""ShieldClient: the shell that performs the requests of core.py with httpx and time.sleep."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Generic, cast

import httpx

from specshield.client import calls
from specshield.client.core import D, Feed, Flow, More, T, Wait, page_of
from specshield.client.models import Decision, Page
from specshield.client.network import bounded
from specshield.client.network.stream import SyncStreams, packed
from specshield.client.network.transport import Exchange, address, headers
from specshield.client.resources import Maps, Policies, Sessions, Specs, performing
from specshield.client.state import SessionState
from specshield.client.wire import Failure, Reply, Request, seconds_value


class ShieldClient:
    """A client of the service at `base_url`.

    `timeout` [s] is the time for one try of a decision, from looking up the server's name to the last byte.
    Tries that prepare something (a map, a policy, a session, a switch) get at least 30 s. A request whose
    answer is lost is sent again, so a call returns or raises within five timeouts, a step within its
    `deadline`. Your own `transport` has to keep these times itself. All errors are
    `SpecshieldError`s; if no answer comes, it is a `TransportError`. `stream`: steps go over one WebSocket
    for each session, in MessagePack, which is faster and needs `pip install 'specshield[stream]'`.
    """

    def __init__(
        self,
        base_url: str,
        api_key: str | None = None,
        timeout: float = 0.5,
        *,
        stream: bool = False,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self._timeout = seconds_value(timeout, "timeout")
        url = address(base_url)
        self._http = httpx.Client(
            base_url=url, headers=headers(api_key), transport=transport or bounded.Transport(url)
        )
        self._streams = SyncStreams(self._http) if stream else None
        self.specs, self.maps = Specs(self), Maps(self)
        self.policies, self.sessions = Policies(self), Sessions(self)
        self._session = Session  # the class of what `sessions` returns

    def __enter__(self) -> ShieldClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    wait_until_ready = performing(calls.wait_until_ready)

    def close(self) -> None:
        self._http.close()
        if self._streams is not None:
            self._streams.close()

    def _run(self, flow: Flow[T], /) -> T:
        began, ends, got = time.monotonic(), math.inf, cast(Any, None)
        try:
            while True:
                command, got = flow.send(got), None
                if isinstance(command, Request):
                    got = self._perform(command, ends)
                elif isinstance(command, More):
                    got = self._more(command)
                elif isinstance(command, Wait):
                    time.sleep(max(0.0, min(command.seconds, ends - time.monotonic())))
                else:
                    ends = command.ends(began, self._timeout)
        except StopIteration as stop:
            return cast(T, stop.value)

    def _perform(self, request: Request, ends: float) -> Reply | Failure:
        exchange = Exchange(request, self._http, self._timeout, ends)
        if exchange.seconds <= 0.0:
            return exchange.failure(httpx.PoolTimeout(""))
        if self._streams is not None:
            if (message := packed(request)) is not None:
                return self._streams.perform(exchange, message)
            self._streams.end(request)
        token = bounded.ENDS.set(exchange.ends)
        try:
            with contextlib.ExitStack() as opened:
                response = opened.enter_context(self._http.stream(**exchange.arguments(self._timeout)))
                exchange.begin(response)
                listens = request.listens and response.status_code == 200
                for chunk in () if listens else response.iter_bytes():
                    exchange.take(chunk)
                reply = exchange.reply(response.status_code, response.headers)
                if isinstance(reply, Failure) and "network_stream" in response.extensions:
                    response.extensions["network_stream"].close()  # what still comes is never read
                elif isinstance(reply, Reply) and listens:
                    return replace(reply, feed=Feed(response.iter_bytes(), opened.pop_all().close))
                return reply
        except httpx.RequestError as error:
            return exchange.failure(error)
        finally:
            bounded.ENDS.reset(token)

    def _more(self, more: More) -> Reply:
        token = bounded.ENDS.set(more.ends)
        try:
            piece: bytes = next(more.feed.pieces, b"")
        except httpx.RequestError:
            piece = b""
        finally:
            bounded.ENDS.reset(token)
        if not piece:
            more.feed.close()
        return more.got(piece)

    def _listed(self, cls: type[T], resource: str) -> Iterator[T]:
        page: Page[T] | None = None
        while page is None or page.next is not None:
            page = self._run(page_of(cls, resource, None if page is None else page.next))
            yield from page.items


class Session(SessionState, Generic[D]):
    """A session. As a context manager it closes the session at the end; the trajectory is kept."""

    def __enter__(self) -> Session[D]:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._run(self._leave(error))

    def events(self, after: int | None = None) -> Iterator[Decision]:
        """The decisions after step `after` as they are made, whoever steps the session; -1: from the first.

        By default they begin after the last step that this object knows of. Each is what `step` returned,
        without its `timings`. The iterator waits for the next decision and ends with the session. A lost
        connection is made again, with no decision left out and none twice. If that fails for two minutes, the
        error is raised, and a later `events(decision.t)` goes on.
        """
        events = self._events(after)
        try:
            while (decision := self._run(events.following())) is not None:
                yield decision
        finally:
            if events.feed is not None:
                events.feed.close()
