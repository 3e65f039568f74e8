"""ShieldClient: the shell that performs the core's requests with httpx and time.sleep."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, Generic, Literal, Protocol, cast, overload

import httpx

from specshield.client import bounded, calls
from specshield.client.core import D, Feed, Flow, More, P, Resource, T, Wait, looks_like, page_of
from specshield.client.models import Decision, LocalDecision, Map, Policy, SessionInfo
from specshield.client.state import SessionState
from specshield.client.stream import SyncStreams, packed
from specshield.client.transport import STALE, Exchange, address, check_open, headers
from specshield.client.wire import TRIES, Failure, Reply, Request
from specshield.errors import NotFound, SpecshieldError

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from specshield.client.models import Beginning


class Run(Protocol):
    def __call__(self, flow: Flow[T], /) -> T: ...


def blocking(flow: Callable[P, Flow[T]]) -> Callable[Concatenate[Any, P], T]:
    """The method of a client, or of a resource of its, that makes this call."""

    @looks_like(flow)
    def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:
        made: T = self._run(flow(*args, **kwargs))
        return made

    return method


class ShieldClient:
    """The service at `base_url`.

    `timeout` [s] is what a decision may take, one try, from looking up the server's name to the last byte;
    what prepares something (a map, a policy, a session) gets at least 30 s. Lost answers are asked for again
    (see `core`), so a call returns or raises within five timeouts, a step within its `deadline`. A
    `transport` of your own has to keep these times itself. Every error is a `SpecshieldError`; no answer is
    a `TransportError`. `stream`: steps go over one WebSocket a session, in MessagePack, which is faster and
    needs `pip install 'specshield[stream]'`.
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
        self._timeout = timeout
        url = address(base_url)
        self._http = httpx.Client(
            base_url=url, headers=headers(api_key), transport=transport or bounded.Transport(url)
        )
        self._streams = SyncStreams(self._http) if stream else None
        self.specs = Specs(self._run)
        self.maps = Maps(self._run)
        self.policies = Policies(self._run)
        self.sessions = Sessions(self._run)

    def __enter__(self) -> ShieldClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    wait_until_ready = blocking(calls.wait_until_ready)

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
        check_open(self._http)
        exchange = Exchange(request, self._http.base_url, self._timeout, ends)
        if exchange.seconds <= 0.0:
            return exchange.failure(httpx.PoolTimeout(""))
        message = None if self._streams is None else packed(request)
        if self._streams is not None and message is not None:
            return self._streams.perform(exchange, message)
        token = bounded.ENDS.set(exchange.ends)
        try:
            with contextlib.ExitStack() as opened:
                response = opened.enter_context(self._http.stream(**exchange.arguments(self._timeout)))
                exchange.begin(response)
                listens = request.listens and response.status_code == 200
                for chunk in () if listens else response.iter_bytes():
                    exchange.take(chunk)
                reply = exchange.reply(response)
                if reply is not None and listens:
                    return replace(reply, feed=Feed(response.iter_bytes(), opened.pop_all().close))
                if reply is None and "network_stream" in response.extensions:
                    response.extensions["network_stream"].close()  # nothing more is read from it
        except httpx.RequestError as error:
            return exchange.failure(error)
        finally:
            bounded.ENDS.reset(token)
        return exchange.failure(httpx.ReadError(STALE)) if reply is None else reply

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


def blocking_step(
    flow: Callable[Concatenate[Session[Any], P], Flow[T]],
) -> Callable[Concatenate[Session[Any], P], T]:
    """The method of a session that makes this call, which is a method of its state."""

    @looks_like(flow)
    def method(self: Session[Any], /, *args: P.args, **kwargs: P.kwargs) -> T:
        return self._run(flow(self, *args, **kwargs))

    return method


def deciding(
    flow: Callable[Concatenate[Session[Any], P], Flow[Any]],
) -> Callable[Concatenate[Session[D], P], D]:
    """As `blocking_step`, of the call whose answer is what this session's steps give."""
    return blocking_step(flow)


def opening(flow: Callable[P, Flow[SessionInfo]]) -> Callable[Concatenate[Resource[Run], P], Session]:
    """The method that makes this call and gives the session that it tells of."""

    @looks_like(flow)
    def method(self: Resource[Run], /, *args: P.args, **kwargs: P.kwargs) -> Session:
        info, given = self._run(flow(*args, **kwargs)), cast(dict[str, Any], kwargs)
        begun = Session[Any](self._run, info, given.get("initial_pose"), given.get("on_failure", "raise"))
        self._run(begun._recall())
        return begun

    return method


def pages(cls: type[T], resource: str) -> Callable[[Resource[Run]], Iterator[T]]:
    """The method that lists all there are."""

    def method(self: Resource[Run]) -> Iterator[T]:
        """All of them, in the order of the server's pages."""
        page = self._run(page_of(cls, resource, None))
        while True:
            yield from page.items
            if page.next is None:
                return
            page = self._run(page_of(cls, resource, page.next))

    return method


class Session(SessionState, Generic[D]):
    """A session; as a context manager it is closed at the end, and its trajectory stays."""

    _run: Run

    def __enter__(self) -> Session[D]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.closed:
            return
        # An error of the block's own is what the caller must see: then one try, whatever comes of it.
        with contextlib.suppress(NotFound if error is None else SpecshieldError):
            self._run(self._close(None, TRIES if error is None else 1))

    step = deciding(SessionState._step)
    switch = blocking_step(SessionState._switch)
    trajectory = blocking_step(SessionState._trajectory)
    save_record = blocking_step(SessionState._save_record)
    close = blocking_step(SessionState._end)

    def events(self, after: int | None = None) -> Iterator[Decision]:
        """The decisions after step `after` as they are made, by whoever asks for them; -1: from the first.

        By default those after the last step that this session knows of. Each is what `step` gave, without its
        `timings`. Waits for the next one, as long as the server answers; ends with the session. A connection
        that is lost is made again, without a gap and without doubles; where that fails for some 13 s, the
        error is raised, and `events(decision.t)` goes on later.
        """
        events = self._events(after)
        try:
            while (decision := self._run(events.following())) is not None:
                yield decision
        finally:
            if events.feed is not None:
                events.feed.close()


class Specs(Resource[Run]):
    validate = blocking(calls.validate)


class Maps(Resource[Run]):
    create = blocking(calls.create_map)
    upload = blocking(calls.upload_map)
    procthor = blocking(calls.procthor_map)
    occupancy_grid = blocking(calls.occupancy_grid_map)
    get = blocking(calls.get_map)
    image = blocking(calls.map_image)
    delete = blocking(calls.delete_map)
    list = pages(Map, "maps")


class Policies(Resource[Run]):
    create = blocking(calls.create_policy)
    upload = blocking(calls.upload_policy)
    get = blocking(calls.get_policy)
    image = blocking(calls.policy_image)
    delete = blocking(calls.delete_policy)
    wait = blocking(calls.wait_policy)
    list = pages(Policy, "policies")


class Sessions(Resource[Run]):
    if TYPE_CHECKING:

        @overload
        def create(
            self, *, on_failure: Literal["raise"] = "raise", **options: Unpack[Beginning]
        ) -> Session[Decision]: ...
        @overload
        def create(
            self, *, on_failure: Literal["witness", "stop"], **options: Unpack[Beginning]
        ) -> Session[Decision | LocalDecision]: ...
        def create(self, **options: Any) -> Any: ...

        @overload
        def get(self, id: str, *, on_failure: Literal["raise"] = "raise") -> Session[Decision]: ...
        @overload
        def get(
            self, id: str, *, on_failure: Literal["witness", "stop"]
        ) -> Session[Decision | LocalDecision]: ...
        def get(self, id: str, **options: Any) -> Any: ...
    else:
        create = opening(calls.create_session)
        get = opening(calls.get_session)
    delete = blocking(calls.delete_session)
    list = pages(SessionInfo, "sessions")
