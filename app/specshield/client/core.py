"""The calls of the SDK without I/O: each is a generator that yields what to send and how long to wait.

A shell (sync.py, aio.py) performs a `Request` and sends the `Reply` or `Failure` into the generator; it
sleeps for a `Wait`; for `More` it reads on in an answer that is read while it comes (events.py). The call
returns what the generator returns. So requests, parsing and retries are written once.

Retries: after a lost answer, a 502, 503 or 504, the same bytes are sent again, at most `tries` times, after
0.05 s, 0.1 s, then every 0.2 s. No try starts later than four timeouts after the first one, nor after the
call's deadline. Repeating is safe: a step is locked by its t and content, maps and policies are addressed by
content, and a session is created under an id that the client chose. A server that is starting has done
nothing yet: the request is sent again after the time that it says (Retry-After), within the same four
timeouts, and this does not count as a try.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar

from specshield.client.models import Page, build
from specshield.client.wire import AWAY, Failure, Reply, Request, check, error_of, get, json_object
from specshield.errors import NotFound, SpecshieldError, Starting, TrainingUnavailable

if TYPE_CHECKING:
    from typing_extensions import TypeVar as Defaulted

    from specshield.client.models import Decision

    D = Defaulted("D", default=Decision)  # what a step of a session returns
else:
    D = TypeVar("D")

P = ParamSpec("P")
T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])
BACKOFF = 0.05  # [s] before the second try, doubled for each further one
LONGEST_WAIT = 0.2  # [s] before another try: a robot's step takes about as long. Chosen by hand.
LONGEST_REST = 2.0  # [s] before another try to connect to a stream of events, for which no robot waits
PATIENCE = 4  # timeouts after which no further try starts
LISTENING = 120.0  # [s], the same for streams of events: longer than a server takes to come back


class Wait(NamedTuple):
    seconds: float


class Within(NamedTuple):
    """Limits the time of the whole call, from its beginning on [s]; None: five timeouts."""

    seconds: float | None

    def ends(self, began: float, timeout: float) -> float:
        """When the call has to end, on the clock by which it began at `began` [s]."""
        return began + ((PATIENCE + 1) * timeout if self.seconds is None else self.seconds)


class Feed(NamedTuple):
    """An answer that is read while it comes. pieces: the shell's iterator over it. close: stops reading."""

    pieces: Any
    close: Callable[[], Any]


class More(NamedTuple):
    """Asks for the next piece of a feed by the time `ends` of time.monotonic(). The shell sends a Reply whose
    content is empty if the feed has ended, was lost or brought nothing in time; the feed is closed then.
    """

    feed: Feed
    ends: float

    def got(self, piece: bytes) -> Reply:
        return Reply(200, {}, piece, 0.0, 0.0)


Flow = Generator[Request | Wait | Within | More, Reply | Failure, T]


class Delivery(NamedTuple):
    """A reply, the number of tries and the time [s] it took."""

    reply: Reply
    tries: int
    seconds: float


def deliver(request: Request) -> Flow[Delivery]:
    """Sends the request, and again where that may help. Raises TransportError if no answer comes."""
    tries, seconds = 0, 0.0
    while True:
        outcome = yield request
        seconds += outcome.seconds
        error: SpecshieldError | None = outcome.error if isinstance(outcome, Failure) else None
        if isinstance(outcome, Reply) and outcome.status in AWAY:
            error = error_of(outcome)
        if isinstance(outcome, Reply) and isinstance(error, Starting):
            wait = _asked_for(outcome)
        else:
            tries += 1
            wait = min(BACKOFF * 2 ** (tries - 1), LONGEST_REST if request.listens else LONGEST_WAIT)
        patience = max(PATIENCE * outcome.timeout, LISTENING if request.listens else 0.0)
        late = seconds + wait > patience or wait >= outcome.left
        passing = error is not None and not isinstance(error, TrainingUnavailable)  # another try may succeed
        if not passing or tries == request.tries or late:
            if isinstance(outcome, Failure):
                outcome.error.details.update(tries=tries, seconds=round(seconds, 3))
                raise outcome.error
            return Delivery(outcome, tries, seconds)
        yield Wait(wait)
        seconds += wait


def _asked_for(reply: Reply) -> float:
    """The pause that a starting server asks for [s]."""
    try:
        return max(BACKOFF, float(reply.headers.get("retry-after", "")))
    except ValueError:  # there is no such header, or it holds a date
        return 1.0


def fetch(request: Request) -> Flow[Reply]:
    """The reply. Raises the error that an unsuccessful reply stands for."""
    reply = (yield from deliver(request)).reply
    check(reply)
    return reply


def call(request: Request) -> Flow[dict[str, Any]]:
    return json_object((yield from deliver(request)).reply)


def erase(request: Request) -> Flow[None]:
    """Sends a DELETE. "Not found" counts as success if an earlier try may have deleted it."""
    delivery = yield from deliver(request)
    try:
        check(delivery.reply)
    except NotFound:
        if delivery.tries == 1:
            raise


def page_of(cls: type[T], resource: str, cursor: str | None) -> Flow[Page[T]]:
    params = {} if cursor is None else {"cursor": cursor}
    raw: Page[Any] = build(Page, (yield from call(get(resource, params=params))))
    return Page(tuple(build(cls, item) for item in raw.items), raw.next)


def looks_like(flow: Callable[..., Any], result: str = "") -> Callable[[F], F]:
    """Gives a shell's method the name, docstring and signature of its call. result: another return type."""

    def dress(method: F) -> F:
        given = inspect.signature(flow)
        parameters = [p for p in given.parameters.values() if p.name != "self"]
        own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        gives = result or str(given.return_annotation).removeprefix("Flow[").removesuffix("]")
        method.__name__, method.__doc__ = flow.__name__.lstrip("_"), flow.__doc__
        vars(method)["__signature__"] = given.replace(parameters=[own, *parameters], return_annotation=gives)
        return method

    return dress
