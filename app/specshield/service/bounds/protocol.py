"""uvicorn's protocols with limits on connections, request heads, unread answers and messages of WebSockets.

Without them, as was measured, uvicorn reads a head of 100 MB as a whole, keeps a connection for ever that
sends or reads nothing, or a byte now and then, and during a flood of pings answers nobody else for 7 s.
"""

from __future__ import annotations

import asyncio
import resource
import socket
import sys
import time
from functools import cache
from typing import Any, cast

import httptools
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode, Frame

from specshield.errors import Busy, HeadersTooLarge, InputError, RequestTimeout, SpecshieldError
from specshield.service import metrics, problems
from specshield.service.settings import Settings

ARRIVED = "arrived"  # in `scope["state"]` once the whole request is here, so that no wait needs a limit
PIECE = 2048  # [bytes]; chosen by hand: a step fits, and the pings that fit take some 1 to 5 ms
SHARE = 0.001  # [s] of a round of the event loop for all streams together, or one piece. Chosen by hand.
FREE = 64 << 10  # [bytes] of each body or message that the limit on all of them together does not count
AT_ONCE = 1 << 16  # [bytes] of an answer that are sent at once: waiting for more would gain nothing
KEPT_FILES = 256  # file descriptors for the store, files and child processes


@cache
def _settings() -> Settings:
    return Settings()


@cache
def most_connections() -> int:
    """The number in the settings, or fewer if the process may not open so many files."""
    return min(
        _settings().max_connections, max(resource.getrlimit(resource.RLIMIT_NOFILE)[0] - KEPT_FILES, 16)
    )


def raise_file_limit() -> None:
    """Raises this process's limit on open files to the highest that it may set."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


class BoundedProtocol(HttpToolsProtocol):
    """A connection counts as waiting until the head of its first request has arrived. If there are too many
    connections, the one that has waited longest is closed for a new one; if none waits, the new one is
    refused. So callers that send nothing are the first to lose their connections, and working robots keep
    theirs. A WebSocket counts as waiting too, once it has had no message for `keep_alive_timeout` seconds.
    """

    # The waiting connections of the process, the oldest first.
    waiting: dict[BoundedProtocol | BoundedStream, None] = {}  # noqa: RUF012

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        # [bytes] of the head that is being read: of its pieces so far, and of its fields
        self._head = self._named = 0
        self._most = _settings().max_header_bytes
        self._in_head = self._upgraded = self._again = False
        self._late: asyncio.TimerHandle | None = None
        super().connection_made(transport)
        self.transport = cast(asyncio.Transport, Corked(transport, self.loop))
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # on Linux: how long a client may leave an answer unread
            patience = int(1000 * _settings().request_timeout)
            transport.get_extra_info("socket").setsockopt(socket.SOL_TCP, socket.TCP_USER_TIMEOUT, patience)
        if len(self.connections) > most_connections():
            oldest = next(iter(self.waiting), None)
            if oldest is None:
                self._refuse(Busy("there are too many connections", expected="the request again, in a while"))
                return
            self.waiting.pop(oldest)
            oldest.transport.abort()
        self.waiting[self] = None
        self._expect_head()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_waiting()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        self._head += len(data) if self._in_head else 0
        self._left: list[bytes | memoryview] = [data]
        while self._left and not self.transport.is_closing():
            self._fed = self._left.pop()
            super().data_received(self._fed)  # type: ignore[arg-type]
        self._fed = b""  # keeps nothing of a body for as long as the connection idles
        if self._head > self._most and not self.transport.is_closing():  # and has not ended yet
            self._refuse_head()
        idle = self.cycle is None or self.cycle.response_complete
        if self._late is None and (self._in_head or idle) and not self._upgraded:
            self._expect_head()

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self._in_head, self._head, self._named = True, 0, 0

    def on_header(self, name: bytes, value: bytes) -> None:
        if not self._in_head:  # a trailer: uvicorn would add it to the headers, which may be read already
            return
        self._named += len(name) + len(value)
        if self._named > self._most:
            raise ValueError("the head is too large")  # ends the parsing: uvicorn calls `send_400_response`
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        self._in_head, self._head = False, 0
        asks = self.parser.should_upgrade() and any(name == b"upgrade" for name, _ in self.headers)
        self._again = asks and not self._should_upgrade()
        if self._again:
            return
        self._stop_waiting()
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        if self._again:
            return
        super().on_message_complete()
        self.scope["state"][ARRIVED] = True

    def _unsupported_upgrade_warning(self) -> None:
        """Reads the request again without its header Upgrade, which a server may ignore: httptools leaves out
        the body of a request that has it. Java's HTTP client and `curl --http2` ask for HTTP/2 in this way.
        """
        if not self._again:
            return
        version, method = self.parser.get_http_version().encode(), self.parser.get_method()
        lines = [name + b": " + value for name, value in self.headers if name != b"upgrade"]
        head = b"\r\n".join([method + b" " + self.url + b" HTTP/" + version, *lines, b"", b""])
        read = cast(httptools.HttpParserUpgrade, sys.exc_info()[1]).args[0]
        self.parser = httptools.HttpRequestParser(self)
        self.parser.set_dangerous_leniencies(lenient_data_after_close=True)  # as uvicorn's parser
        self._left += [memoryview(self._fed)[read:], head]  # `data_received` takes the last one first

    def handle_websocket_upgrade(self) -> None:
        self._upgraded = True
        super().handle_websocket_upgrade()
        opening = self.transport.get_protocol()
        if not getattr(opening, "handshake_initiated", True):  # nothing else would answer or end it
            expected = "a GET of HTTP/1.1 without a body, which opens a WebSocket"
            self._refuse(InputError("the request cannot open a WebSocket", expected=expected))

    def send_400_response(self, msg: str) -> None:
        if self._in_head and self._named > self._most:
            self._refuse_head()
        else:
            super().send_400_response(msg)

    def _expect_head(self) -> None:
        self._late = self.loop.call_later(_settings().request_timeout, self._too_late)

    def _too_late(self) -> None:
        self._late = None
        if self._in_head:
            self._refuse(RequestTimeout("the request's head took too long", expected="a head sent at once"))
        else:
            self.transport.close()

    def _refuse_head(self) -> None:
        expected = f"at most {self._most} bytes"
        self._refuse(HeadersTooLarge("the request's head is too large", expected=expected, limit=self._most))

    def _stop_waiting(self) -> None:
        self.waiting.pop(self, None)
        if self._late is not None:
            self._late.cancel()
            self._late = None

    def _refuse(self, error: SpecshieldError) -> None:
        """Sends a problem and closes the connection, without the application."""
        self._stop_waiting()
        metrics.refused(error.type)
        answer = problems.ProblemResponse(error, {"Connection": "close"})
        head = b"".join(name + b": " + value + b"\r\n" for name, value in answer.raw_headers)
        status = STATUS_LINE[problems.status_of(error)]
        self.transport.write(status + head + b"\r\n" + bytes(answer.body))
        self.transport.close()


class BoundedStream(WebSocketsSansIOProtocol):
    """Handles what arrived piece by piece, so that others can run: uvicorn takes 40,000 messages at once.

    The streams take turns: in a round of the event loop the pieces of all of them take about `SHARE`.
    """

    # The streams that have a piece to be handled, the first in line first. While there is one, `_take_turns`
    # is called soon.
    turns: dict[BoundedStream, None] = {}  # noqa: RUF012
    _rest = b""
    _joined = bytearray()  # the fragments of a message so far
    held = 0  # [bytes] of messages that have not come as a whole, of all streams
    _held = 0  # of this one

    def connection_lost(self, exc: Exception | None) -> None:
        self.turns.pop(self, None)
        self._count(0)
        super().connection_lost(exc)

    def data_received(self, data: bytes = b"") -> None:
        if not self.handshake_initiated:  # this is the handshake
            super().data_received(data)
            return
        self._rest += data
        if self.transport.is_closing():
            return
        if not self._rest:
            self.transport.resume_reading()
            return
        self.transport.pause_reading()
        if not self.turns:
            self.loop.call_soon(self._take_turns)
        self.turns[self] = None

    def _take_turns(self) -> None:
        end = time.perf_counter() + SHARE
        while self.turns:
            stream = next(iter(self.turns))
            del self.turns[stream]
            stream._handle_piece()
            if time.perf_counter() > end:
                break
        if self.turns:
            self.loop.call_soon(self._take_turns)

    def _handle_piece(self) -> None:
        piece, self._rest = self._rest[:PIECE], self._rest[PIECE:]
        super().data_received(piece)
        self._count(sum(map(len, (self._rest, self.conn.reader.buffer, self._joined, *self.frames))))
        if (
            self._held
            and BoundedStream.held > _settings().max_bodies_bytes
            and not self.transport.is_closing()
        ):
            self.conn.fail(CloseCode.TRY_AGAIN_LATER, "the server cannot hold more bytes of messages now")
            self.handle_parser_exception()  # sends that and closes
        if self.transport.is_closing():
            self._rest = b""
            self._count(0)
            return
        if not self.queue.empty():  # `receive` goes on
            return
        if self._rest:
            self.turns[self] = None
        else:
            self.transport.resume_reading()

    def _count(self, size: int) -> None:
        """Notes how much the stream holds, beyond what a usual step takes."""
        held = max(size - FREE, 0)
        BoundedStream.held += held - self._held
        self._held = held

    def handle_cont(self, event: Frame) -> None:
        """Joins fragments as they come: uvicorn's list of a message of 1 MB in single bytes takes 100 MB."""
        if self.frames:
            self._joined = bytearray(self.frames.pop())
        self._joined += event.data
        if event.fin:
            self.frames = [bytes(self._joined)]
            self.send_receive_event_to_app()
            self._joined = bytearray()

    def shutdown(self) -> None:
        """An open stream ends itself after the step that is being decided (`leaving.Streams`)."""
        if self.close_sent or not self.handshake_complete:
            super().shutdown()

    async def receive(self) -> Any:
        waiting = BoundedProtocol.waiting
        idle = self.loop.call_later(_settings().keep_alive_timeout, waiting.setdefault, self)
        try:
            message = await self.queue.get()
        finally:
            idle.cancel()
            waiting.pop(self, None)
        await asyncio.sleep(0)
        if self.queue.empty():
            self.data_received()
        return message


class Corked:
    """A transport that sends an answer's head and body together, in the next round of the event loop and
    before that reads more.

    uvloop sends at once, so that uvicorn's two writes for an answer are two system calls, each of which takes
    as long as parsing a request (measured with py-spy under `python -m benchmarks.step_cost`).
    """

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._transport, self._loop = transport, loop
        self._held: list[bytes] = []

    def write(self, data: bytes) -> None:
        if not self._held:
            self._loop.call_soon(self._flush)
        self._held.append(data)
        if len(data) > AT_ONCE:
            self._flush()

    def close(self) -> None:
        self._flush()
        self._transport.close()

    def _flush(self) -> None:
        if self._held:
            content = b"".join(self._held) if len(self._held) > 1 else self._held[0]
            self._held.clear()
            if not self._transport.is_closing():  # else the caller has left
                self._transport.write(content)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)
