"""Reads the decisions of a session from the server's stream of events (docs/watch.md), whoever steps it.

It does no I/O, like all calls (core.py). A connection that ends without `event: end`, breaks, or brings no
whole line for SILENCE seconds is given up. The next one goes on after the last decision that was read.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from specshield.client.core import Feed, Flow, More, Wait, fetch
from specshield.client.models import Decision
from specshield.client.network.stream import LONGEST
from specshield.client.wire import TRIES, Failure, Request, path
from specshield.errors import ServerError

SILENCE = 30.0  # [s] without a whole line; two heartbeats of the server
PAUSE = 1.0  # [s] before a lost connection is made again, as the server's `retry` says
RESUMING = 100  # tries to make it again: more than fit into LISTENING


class Events:
    """The decisions after step `after` of a session. feed: the open connection, for the shell to close.

    decided: makes a decision of an answer (the contract's names). switched: called with the rule of a switch.
    """

    def __init__(
        self,
        id: str,
        after: int,
        decided: Callable[[Mapping[str, Any]], Decision],
        switched: Callable[[Mapping[str, Any]], object],
    ) -> None:
        self._path, self._after, self._decided = path("sessions", id, "events"), after, decided
        self._switched = switched
        self._tries, self._over, self._found = TRIES, False, deque[Decision]()
        self._rest, self._event = bytearray(), dict[bytes, bytes]()
        self.feed: Feed | None = None

    def following(self) -> Flow[Decision | None]:
        """The next decision; None once the session is over."""
        ends = time.monotonic() + SILENCE
        while not self._found and not self._over:
            if self.feed is None:
                yield from self._connect()
                ends = time.monotonic() + SILENCE
                continue
            piece = yield More(self.feed, ends)
            if isinstance(piece, Failure) or not piece.content:
                self.feed = None
                yield Wait(PAUSE)
            elif lines := self._lines(piece.content):
                ends = time.monotonic() + SILENCE
                for line in lines:
                    self._take(line.rstrip(b"\r"))
        return self._found.popleft() if self._found else None

    def _connect(self) -> Flow[None]:
        params = {"after": str(self._after)}
        request = Request("GET", self._path, params=params, slow=True, tries=self._tries, listens=True)
        reply = yield from fetch(request)
        self._over, self.feed, self._tries = reply.status == 204, reply.feed, RESUMING
        self._rest.clear()
        self._event.clear()
        if not self._over and not reply.headers.get("content-type", "").startswith("text/event-stream"):
            told = "the answer is not a stream of events; is this a specshield server?"
            raise ServerError(told, status=reply.status)

    def _lines(self, piece: bytes) -> list[bytes]:
        """The lines that are complete now. Raises ServerError for a line that is too long."""
        self._rest += piece
        *whole, rest = bytes(self._rest).split(b"\n") if b"\n" in piece else [b""]
        if max(map(len, whole), default=len(self._rest)) > LONGEST or len(rest) > LONGEST:
            raise ServerError(f"a line of the stream of events has more than {LONGEST} bytes")
        self._rest = bytearray(rest) if whole else self._rest
        return whole

    def _take(self, line: bytes) -> None:
        name, _, value = line.partition(b":")
        if name in (b"event", b"data"):
            self._event[name] = value.removeprefix(b" ")
        if line:
            return
        kind, data = self._event.get(b"event", b"message"), self._event.get(b"data")
        self._event.clear()
        self._over = self._over or kind == b"end"
        if data is None or kind not in (b"message", b"switch") or self._over:
            return
        try:
            if kind == b"switch":
                self._switched(json.loads(data))
                return
            decision = self._decided(json.loads(data))
        except (ValueError, RecursionError, AttributeError, KeyError, TypeError) as error:
            told = f"the server sent an event that this client does not understand: {error}"
            raise ServerError(told) from error
        if decision.t > self._after:
            self._found.append(decision)
            self._after = decision.t
