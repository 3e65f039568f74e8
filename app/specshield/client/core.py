"""How a call of the SDK is made without I/O: a generator yields what to send and how long to wait.

A shell (sync.py, aio.py) performs a `Request` and sends its `Reply` or `Failure` in; it sleeps for a
`Wait`; it reads `More` of an answer that is read while it comes (events.py). The generator's return value is
the call's. So requests, parsing and retries exist once.

Retries: a lost answer, 502, 503 or 504 is followed by the same bytes again, at most `tries` times, after
0.05 s, 0.1 s, then every 0.2 s. No try starts later than four timeouts after the first, nor after the
deadline of the call. All that is repeated is safe to repeat: steps are locked by t and content, maps and
policies are addressed by content, and a session is created under an id the client chose. A server that
says it is starting has done nothing yet: it is asked again when it says so (Retry-After), within the same
four timeouts, and such an answer is not counted as a try.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar

from specshield.client.models import Page, build
from specshield.client.wire import Failure, Reply, Request, check, error_of, get, json_object
from specshield.errors import NotFound, SpecshieldError, Starting, TrainingUnavailable

if TYPE_CHECKING:
    from typing_extensions import TypeVar as Defaulted

    from specshield.client.models import Decision

    D = Defaulted("D", default=Decision)  # what a step of a session gives
else:
    D = TypeVar("D")

P = ParamSpec("P")
T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])
BACKOFF = 0.05  # s before the second try, doubled for each that follows
LONGEST_WAIT = 0.2  # s before another try: a step takes a robot about as long. Chosen by hand.
LONGEST_REST = 2.0  # s before another try to listen, which nothing waits for
PATIENCE = 4  # timeouts after which no further try starts
LISTENING = 120.0  # s after which none does to listen again: longer than a server takes to come back


class Wait(NamedTuple):
    seconds: float


class Within(NamedTuple):
    """From its beginning to its end, this call may take so many seconds; None: five timeouts."""

    seconds: float | None

    def ends(self, began: float, timeout: float) -> float:
        """On the clock on which the call began at `began`."""
        return began + ((PATIENCE + 1) * timeout if self.seconds is None else self.seconds)


class Feed(NamedTuple):
    """An answer that is read while it comes. pieces: an iterator of the shell's. close: leaves it."""

    pieces: Any
    close: Callable[[], Any]


class More(NamedTuple):
    """The next piece of a feed, as the content of a Reply, by `ends` on the clock of time.monotonic(). It is
    empty where the feed has ended, was lost or brought nothing in time; the feed is closed then.
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
    """Send until there is an answer worth having; TransportError where there is none."""
    tries, seconds = 0, 0.0
    while True:
        outcome = yield request
        seconds += outcome.seconds
        error: SpecshieldError | None = outcome.error if isinstance(outcome, Failure) else None
        if isinstance(outcome, Reply) and outcome.status in (502, 503, 504):  # it is not there now
            error = error_of(outcome)
        if isinstance(outcome, Reply) and isinstance(error, Starting):
            wait = _asked_for(outcome)
        else:
            tries += 1
            wait = min(BACKOFF * 2 ** (tries - 1), LONGEST_REST if request.listens else LONGEST_WAIT)
        patience = max(PATIENCE * outcome.timeout, LISTENING if request.listens else 0.0)
        late = seconds + wait > patience or wait >= outcome.left
        passing = error is not None and not isinstance(error, TrainingUnavailable)  # it may go in a moment
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
    except ValueError:  # none, or a date
        return 1.0


def fetch(request: Request) -> Flow[Reply]:
    """The reply, which is not an error."""
    reply = (yield from deliver(request)).reply
    check(reply)
    return reply


def call(request: Request) -> Flow[dict[str, Any]]:
    return json_object((yield from deliver(request)).reply)


def erase(request: Request) -> Flow[None]:
    """DELETE; gone already, after a try of our own whose answer was lost, is gone."""
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
    """Gives a shell's method the name, docstring and parameters of its call. result: if not the call's."""

    def dress(method: F) -> F:
        given = inspect.signature(flow)
        parameters = [p for p in given.parameters.values() if p.name != "self"]
        own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        gives = result or str(given.return_annotation).removeprefix("Flow[").removesuffix("]")
        method.__name__, method.__doc__ = flow.__name__.lstrip("_"), flow.__doc__
        vars(method)["__signature__"] = given.replace(parameters=[own, *parameters], return_annotation=gives)
        return method

    return dress
