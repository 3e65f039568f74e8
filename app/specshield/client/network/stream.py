"""Steps over one WebSocket for each session, in MessagePack, for `ShieldClient(url, stream=True)`.

A message is the body of a step; its answer is a message too, also a problem document. A try has the same time
limit as over HTTP. After a failed try its connection is closed, so that a late answer is never read, and the
next try makes a new one; the connection of a finished session is closed too. Steps longer than `SHORT` go
over HTTP: a short message fits into the socket's buffer, so that sending it cannot block.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

import httpx

from specshield.client.network.bounded import in_thread, is_direct
from specshield.client.network.transport import LATE, MINE, STALE, Exchange
from specshield.client.wire import Failure, Reply, Request
from specshield.errors import InputError

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection as Socket

SHORT = 16_384  # [bytes] chosen by hand, far below the size of the socket's buffer
LONGEST = 4 << 20  # [bytes] of an answer; a step of 256 actions with all its witnesses has 1 MB
PROBLEM = {"content-type": "application/problem+json"}


def packed(request: Request) -> bytes | None:
    """The message of a step; None for a request that goes over HTTP."""
    import msgpack

    if request.message is None:
        return None
    message: bytes = msgpack.packb(request.message)
    return message if len(message) <= SHORT else None


def leave(connection: Any) -> None:
    """Closes a connection without a handshake, which would wait for the other side."""
    with contextlib.suppress(OSError, AttributeError):
        connection.socket.shutdown(socket.SHUT_RDWR)


def abort(connection: Any) -> None:
    """The same for asyncio."""
    with contextlib.suppress(AttributeError):
        connection.transport.abort()


class Streams:
    """What both shells share: the open connections, and how an answer is read."""

    _here: Callable[[], Any]  # the process, or the event loop, to which new connections belong
    _leave: Callable[[Any], None]  # closes a connection

    def __init__(self, http: httpx.Client | httpx.AsyncClient) -> None:
        """Raises InputError if a package is missing."""
        try:
            import msgpack  # noqa: F401
            import websockets  # noqa: F401
        except ImportError as error:
            told = f"stream=True needs the package {error.name}, which is not installed"
            expected = "pip install 'specshield[stream]', or stream=False"
            raise InputError(told, path="stream", expected=expected) from error
        self._http = http
        self._open: dict[tuple[Any, str], Any] = {}  # by the result of `_here`, and the path of the steps

    def close(self) -> None:
        while self._open:
            (there, _), connection = self._open.popitem()
            if there == self._here():
                self._leave(connection)

    def end(self, request: Request) -> None:
        """Closes the stream of a session if this request closes or erases the session."""
        if request.method != "GET":
            steps = request.path.removesuffix("/close") + "/steps"
            self._leave(self._open.pop((self._here(), steps), None))

    def _keep(self, connection: Any, path: str, reply: Reply | Failure | None) -> None:
        """Keeps a connection for the next step; closes it without an answer, or if the session is over."""
        over = not isinstance(reply, Reply) or reply.parsed.get("finished") or self._http.is_closed
        if over or self._open.setdefault((self._here(), path), connection) is not connection:
            self._leave(connection)

    def _options(self, exchange: Exchange) -> dict[str, Any]:
        """The arguments of websockets' `connect`."""
        base = str(self._http.base_url.copy_with(scheme=self._http.base_url.scheme.replace("http", "ws")))
        key = self._http.headers.get("Authorization")
        return {
            "uri": base.rstrip("/") + exchange.request.path.removesuffix("/steps") + "/stream",
            "additional_headers": {} if key is None else {"Authorization": key},
            "proxy": None if is_direct(self._http.base_url.host) else True,
            "compression": None,
            "ping_interval": None,
            "open_timeout": exchange.seconds,
            "max_size": LONGEST,
        }

    def _read(self, exchange: Exchange, message: bytes | str) -> Reply | Failure:
        """The reply that a message holds; a Failure if it is no answer, or is about another step. Raises
        httpx.ReadTimeout if too little time is left to parse it.
        """
        import msgpack

        exchange.take(message if isinstance(message, bytes) else b"")
        try:
            document = msgpack.unpackb(exchange.content)
        except (ValueError, msgpack.exceptions.UnpackException):
            document = None
        if not isinstance(document, dict):
            return exchange.failure(httpx.ReadError(STALE))
        status = document.get("status", 200) if "type" in document else 200
        return exchange.reply(status, PROBLEM if status != 200 else {}, document)


def _failed(exchange: Exchange, error: Exception) -> Reply | Failure:
    """The outcome of a try whose connection failed. An HTTP answer may have refused the handshake."""
    answer = getattr(error, "response", None)
    if answer is None:
        return exchange.failure(error)
    exchange.content += answer.body or b""
    # The handshake sends no id of its own, so any that came back is another's invention.
    headers = {name: value for name, value in answer.headers.raw_items() if name.lower() != MINE.lower()}
    return exchange.reply(answer.status_code, headers)


class SyncStreams(Streams):
    """As for HTTP (bounded.py), a forked process opens its own connections."""

    _here, _leave = staticmethod(os.getpid), staticmethod(leave)

    def perform(self, exchange: Exchange, message: bytes) -> Reply | Failure:
        import websockets

        path, reply = exchange.request.path, None
        connection: Any = self._open.pop((self._here(), path), None)
        try:
            connection = connection or self._connected(exchange)
            connection.send(message)
            reply = self._read(exchange, connection.recv(max(exchange.ends - time.monotonic(), 0.0)))
            return reply
        except (httpx.RequestError, websockets.WebSocketException, OSError, UnicodeError) as error:
            return _failed(exchange, error)
        finally:
            self._keep(connection, path, reply)

    def _connected(self, exchange: Exchange) -> Socket:
        """Connects in a thread, since looking up a name takes no time limit."""
        from websockets.sync.client import connect

        def late(made: Future[Socket]) -> None:
            if made.exception() is None:
                leave(made.result())

        options = self._options(exchange)
        made: Future[Socket] = in_thread(lambda: connect(**options).__enter__(), exchange.ends, late)
        if not made.done():
            raise TimeoutError
        return made.result()


class AsyncStreams(Streams):
    _here, _leave = staticmethod(asyncio.get_running_loop), staticmethod(abort)

    async def perform(self, exchange: Exchange, message: bytes) -> Reply | Failure:
        import websockets

        try:
            seconds = max(exchange.ends - time.monotonic(), 0.0)
            return await asyncio.wait_for(self._asked(exchange, message), seconds)
        except (*LATE, httpx.RequestError, websockets.WebSocketException, OSError, UnicodeError) as error:
            return _failed(exchange, error)

    async def _asked(self, exchange: Exchange, message: bytes) -> Reply | Failure:
        """Sends and receives. A connection without an answer is closed, also after a cancellation."""
        from websockets.asyncio.client import connect

        path, reply = exchange.request.path, None
        connection: Any = self._open.pop((self._here(), path), None)
        if connection is None:
            for other in [kept for kept in list(self._open) if kept[0].is_closed()]:
                self._open.pop(other, None)  # connections of earlier calls of asyncio.run
            try:
                connection = await connect(**self._options(exchange)).__aenter__()
            except RuntimeError as error:  # the machine has no thread left, to look up the name
                raise OSError(str(error)) from error
        try:
            await connection.send(message)
            reply = self._read(exchange, await connection.recv())
            return reply
        finally:
            self._keep(connection, path, reply)
