"""ShieldClient: the shell that performs the core's requests with httpx and time.sleep."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, cast

import httpx

from specshield.client import bounded, calls
from specshield.client.core import Flow, Wait, looks_like, page_of
from specshield.client.models import Map, Policy, SessionInfo
from specshield.client.state import SessionState
from specshield.client.transport import STALE, Exchange, address, check_open, headers
from specshield.client.wire import TRIES, Failure, Numbers, Reply, Request
from specshield.errors import NotFound, SpecshieldError

P = ParamSpec("P")
T = TypeVar("T")


class Run(Protocol):
    def __call__(self, flow: Flow[T], /) -> T: ...


class ShieldClient:
    """The service at `base_url`.

    `timeout` [s] is what a decision may take, one try, from looking up the server's name to the last byte;
    what prepares something (a map, a policy, a session) gets at least 30 s. Lost answers are asked for again
    (see `core`), so a call returns or raises within five timeouts, a step within its `deadline`. A
    `transport` of your own has to keep these times itself. Every error is a `SpecshieldError`; no answer is
    a `TransportError`.
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
        url = address(base_url)
        self._http = httpx.Client(
            base_url=url, headers=headers(api_key), transport=transport or bounded.Transport(url)
        )
        self.specs = Specs(self._run)
        self.maps = Maps(self._run)
        self.policies = Policies(self._run)
        self.sessions = Sessions(self._run)

    def __enter__(self) -> ShieldClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def wait_until_ready(self, timeout: float = 120.0) -> None:
        """Return when the server is ready to decide: its first start takes about half a minute.

        A server that cannot be reached yet is waited for too. Raises TransportTimeout after `timeout` [s],
        which says how far the server was.
        """
        self._run(calls.wait_until_ready(timeout))

    def close(self) -> None:
        self._http.close()

    def _run(self, flow: Flow[T], /) -> T:
        began, ends = time.monotonic(), math.inf
        try:
            command = next(flow)
            while True:
                if isinstance(command, Request):
                    command = flow.send(self._perform(command, ends))
                    continue
                if isinstance(command, Wait):
                    time.sleep(max(0.0, min(command.seconds, ends - time.monotonic())))
                else:
                    ends = command.ends(began, self._timeout)
                command = next(flow)
        except StopIteration as stop:
            return cast(T, stop.value)

    def _perform(self, request: Request, ends: float) -> Reply | Failure:
        check_open(self._http)
        exchange = Exchange(request, self._http.base_url, self._timeout, ends)
        if exchange.seconds <= 0.0:
            return exchange.failure(httpx.PoolTimeout(""))
        token = bounded.ENDS.set(exchange.ends)
        try:
            with self._http.stream(**exchange.arguments(self._timeout)) as response:
                exchange.begin(response)
                for chunk in response.iter_bytes():
                    exchange.take(chunk)
                reply = exchange.reply(response)
                if reply is None:
                    hang_up(response)
        except httpx.RequestError as error:
            return exchange.failure(error)
        finally:
            bounded.ENDS.reset(token)
        return exchange.failure(httpx.ReadError(STALE)) if reply is None else reply


def hang_up(response: httpx.Response) -> None:
    """Close the connection under a response, so that nothing more is read from it."""
    if "network_stream" in response.extensions:
        response.extensions["network_stream"].close()


class Resource:
    """Some of the calls, bound to a client."""

    def __init__(self, run: Run) -> None:
        self._run = run


def blocking(flow: Callable[P, Flow[T]]) -> Callable[Concatenate[Resource, P], T]:
    """The method of a resource that makes this call."""

    @looks_like(flow)
    def method(self: Resource, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return self._run(flow(*args, **kwargs))

    return method


def blocking_step(flow: Callable[Concatenate[Session, P], Flow[T]]) -> Callable[Concatenate[Session, P], T]:
    """The method of a session that makes this call, which is a method of its state."""

    @looks_like(flow)
    def method(self: Session, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return self._run(flow(self, *args, **kwargs))

    return method


def opening(flow: Callable[P, Flow[SessionInfo]]) -> Callable[Concatenate[Resource, P], Session]:
    """The method that makes this call and gives the session that it tells of."""

    @looks_like(flow)
    def method(self: Resource, /, *args: P.args, **kwargs: P.kwargs) -> Session:
        return Session(self._run, self._run(flow(*args, **kwargs)), cast(Any, kwargs.get("initial_pose")))

    return method


def pages(cls: type[T], resource: str) -> Callable[[Resource], Iterator[T]]:
    """The method that lists all there are."""

    def method(self: Resource) -> Iterator[T]:
        """All of them, in the order of the server's pages."""
        page = self._run(page_of(cls, resource, None))
        while True:
            yield from page.items
            if page.next is None:
                return
            page = self._run(page_of(cls, resource, page.next))

    return method


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

    step = blocking_step(SessionState._step)
    trajectory = blocking_step(SessionState._trajectory)
    close = blocking_step(SessionState._end)


class Specs(Resource):
    validate = blocking(calls.validate)


class Maps(Resource):
    create = blocking(calls.create_map)
    upload = blocking(calls.upload_map)
    procthor = blocking(calls.procthor_map)
    occupancy_grid = blocking(calls.occupancy_grid_map)
    get = blocking(calls.get_map)
    image = blocking(calls.map_image)
    list = pages(Map, "maps")


class Policies(Resource):
    create = blocking(calls.create_policy)
    upload = blocking(calls.upload_policy)
    get = blocking(calls.get_policy)
    delete = blocking(calls.delete_policy)
    wait = blocking(calls.wait_policy)
    list = pages(Policy, "policies")


class Sessions(Resource):
    create = opening(calls.create_session)
    get = opening(calls.get_session)
    delete = blocking(calls.delete_session)
    list = pages(SessionInfo, "sessions")
