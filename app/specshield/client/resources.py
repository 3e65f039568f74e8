"""The calls of calls.py as methods of a client, whose `_run` performs them, blocking or with `await`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Concatenate, Generic, TypeVar, cast

from specshield.client import calls, wire
from specshield.client.core import Flow, P, T, looks_like
from specshield.client.models import Map, Policy, SessionInfo

C = TypeVar("C")

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Coroutine, Iterator
    from typing import Literal, Protocol, TypeAlias, overload

    from typing_extensions import Unpack

    from specshield.client.aio import AsyncSession, AsyncShieldClient
    from specshield.client.core import D
    from specshield.client.models import Beginning, Decision, LocalDecision
    from specshield.client.sync import Session, ShieldClient

    S_co = TypeVar("S_co", covariant=True)
    A_co = TypeVar("A_co", covariant=True)
    Sync: TypeAlias = "Resource[ShieldClient]"
    Async: TypeAlias = "Resource[AsyncShieldClient]"
    Blocking: TypeAlias = "ShieldClient | Session[Any] | Sync"
    Awaiting: TypeAlias = "AsyncShieldClient | AsyncSession[Any] | Async"

    class Method(Protocol[P, S_co, A_co]):
        """For type checkers: a method that returns one thing, and in an asyncio client another."""

        @overload
        def __get__(self, of: Blocking, owner: Any) -> Callable[P, S_co]: ...
        @overload
        def __get__(self, of: Awaiting, owner: Any) -> Callable[P, A_co]: ...

    class Deciding(Protocol[P]):
        """A method that returns what the steps of its session return."""

        @overload
        def __get__(self, of: Session[D], owner: Any) -> Callable[P, D]: ...
        @overload
        def __get__(self, of: AsyncSession[D], owner: Any) -> Callable[P, Coroutine[Any, Any, D]]: ...


class Resource(Generic[C]):
    """The calls for one kind of thing, bound to a client."""

    def __init__(self, client: C) -> None:
        self._client: Any = client

    def _run(self, flow: Flow[Any]) -> Any:
        return self._client._run(flow)


def performing(flow: Callable[P, Flow[T]]) -> Method[P, T, Coroutine[Any, Any, T]]:
    """A method of a client, or of one of its resources, that makes this call."""

    @looks_like(flow)
    def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> Any:
        return self._run(flow(*args, **kwargs))

    return cast("Method[P, T, Coroutine[Any, Any, T]]", method)


def stepping(flow: Callable[Concatenate[Any, P], Flow[T]]) -> Method[P, T, Coroutine[Any, Any, T]]:
    """A method of a session that makes this call, which is itself a method of `SessionState`."""

    @looks_like(flow)
    def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> Any:
        return self._run(flow(self, *args, **kwargs))

    return cast("Method[P, T, Coroutine[Any, Any, T]]", method)


def deciding(flow: Callable[Concatenate[Any, P], Flow[Any]]) -> Deciding[P]:
    """As `stepping`, for the call that decides a step."""
    return cast("Deciding[P]", stepping(flow))


def listing(cls: type[T], resource: str) -> Method[[], Iterator[T], AsyncIterator[T]]:
    def method(self: Any) -> Any:
        """All of them, in the order of the server's pages."""
        return self._client._listed(cls, resource)

    method.__name__ = "list"
    return cast("Method[[], Iterator[T], AsyncIterator[T]]", method)


def opening(flow: Callable[..., Flow[SessionInfo]]) -> Any:
    """A method that makes this call and returns the session that the answer describes."""

    def opened(client: Any, args: Any, given: dict[str, Any]) -> Flow[Any]:
        pose, on_failure = given.get("initial_pose"), given.get("on_failure", "raise")
        if pose is not None:  # it may be an iterator, which can be read only once
            given["initial_pose"] = pose = wire.pose_values(pose, "initial_pose")
        info = yield from flow(*args, **given)
        begun = client._session(client._run, info, pose, on_failure)
        yield from begun._recall()
        return begun

    @looks_like(flow, "Session")
    def method(self: Any, /, *args: Any, **kwargs: Any) -> Any:
        return self._run(opened(self._client, args, kwargs))

    return method


class Specs(Resource[C]):
    validate = performing(calls.validate)


class Maps(Resource[C]):
    create = performing(calls.create_map)
    upload = performing(calls.upload_map)
    procthor = performing(calls.procthor_map)
    occupancy_grid = performing(calls.occupancy_grid_map)
    get = performing(calls.get_map)
    image = performing(calls.map_image)
    delete = performing(calls.delete_map)
    list = listing(Map, "maps")


class Policies(Resource[C]):
    create = performing(calls.create_policy)
    upload = performing(calls.upload_policy)
    get = performing(calls.get_policy)
    image = performing(calls.policy_image)
    delete = performing(calls.delete_policy)
    wait = performing(calls.wait_policy)
    list = listing(Policy, "policies")


class Sessions(Resource[C]):
    if TYPE_CHECKING:
        Raise = Literal["raise"]
        Local = Literal["witness", "stop"]  # the loop goes on by itself
        Either = Decision | LocalDecision

        @overload
        def create(
            self: Sync, *, on_failure: Raise = "raise", **options: Unpack[Beginning]
        ) -> Session[Decision]: ...
        @overload
        def create(self: Sync, *, on_failure: Local, **options: Unpack[Beginning]) -> Session[Either]: ...
        @overload
        def create(
            self: Async, *, on_failure: Raise = "raise", **options: Unpack[Beginning]
        ) -> Coroutine[Any, Any, AsyncSession[Decision]]: ...
        @overload
        def create(
            self: Async, *, on_failure: Local, **options: Unpack[Beginning]
        ) -> Coroutine[Any, Any, AsyncSession[Either]]: ...
        def create(self, **options: Any) -> Any: ...

        @overload
        def get(self: Sync, id: str, *, on_failure: Raise = "raise") -> Session[Decision]: ...
        @overload
        def get(self: Sync, id: str, *, on_failure: Local) -> Session[Either]: ...
        @overload
        def get(
            self: Async, id: str, *, on_failure: Raise = "raise"
        ) -> Coroutine[Any, Any, AsyncSession[Decision]]: ...
        @overload
        def get(self: Async, id: str, *, on_failure: Local) -> Coroutine[Any, Any, AsyncSession[Either]]: ...
        def get(self, id: str, **options: Any) -> Any: ...
    else:
        create = opening(calls.create_session)
        get = opening(calls.get_session)
    delete = performing(calls.delete_session)
    list = listing(SessionInfo, "sessions")
