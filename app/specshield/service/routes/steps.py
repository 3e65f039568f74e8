"""The steps of a session, as requests and as the messages of a WebSocket. Both are plain ASGI, since the own
handling of FastAPI takes longer than a decision. The middlewares apply to them as to all other routes.

    POST /v1/sessions/{id}/steps    routes/sessions.py describes it for OpenAPI
    /v1/sessions/{id}/stream        the WebSocket: steps as messages, answered in order

A text frame is a step in JSON, a binary frame a step in MessagePack. The answer has the same form, and so has
a problem document, which is known by its `type` and `status`. A session decides one step at a time: further
messages of the caller wait in the connection, which holds a few and then reads no more.
"""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
import time
from collections import defaultdict
from types import SimpleNamespace
from typing import Any

from starlette.types import ASGIApp, Receive, Scope, Send

from specshield.errors import InputError, ServerError, SpecshieldError
from specshield.service import metrics, problems
from specshield.service.routes.messages import MSGPACK, accepts, read_step, write_problem
from specshield.service.schemas.answers import to_json, to_msgpack
from specshield.service.schemas.base import ID
from specshield.service.schemas.steps import StepBody
from specshield.service.sessions.steps import LONG_BODY
from specshield.service.state import Server
from specshield.service.storage.store import scoped
from specshield.service.watch import logs

STEPS = re.compile(rf"/v1/sessions/({ID})/steps")
STREAM = re.compile(rf"/v1/sessions/({ID})/stream")
STEPS_ROUTE = SimpleNamespace(path="/v1/sessions/{session_id}/steps")  # what the metrics call it
STREAM_ROUTE = "/v1/sessions/{session_id}/stream"
UPGRADE = "Upgrade: websocket, which a proxy in front of the server has to pass on, and Connection"
PACKED, JSON = MSGPACK.encode(), b"application/json"
GOING_AWAY, REFUSED = 1001, 1008  # codes of RFC 6455: the server stops; a policy of the server is violated
log = logging.getLogger("specshield")


class StepRoutes:
    """Answers the steps and the streams, and passes everything else on to `app`. Errors of requests are
    answered by middleware.py.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        kind = scope["type"]
        if kind == "http" and scope["method"] == "POST" and (found := STEPS.fullmatch(scope["path"])):
            scope["path_params"] = {"session_id": found[1]}
            await _answer_step(scope, receive, send)
        elif kind in ("http", "websocket") and (found := STREAM.fullmatch(scope["path"])):
            scope["path_params"] = {"session_id": found[1]}
            if kind == "http":
                raise InputError("this opens no WebSocket", path="Upgrade", expected=UPGRADE)
            await _serve_stream(scope, receive, send)
        else:
            await self.app(scope, receive, send)


async def _answer_step(scope: Scope, receive: Receive, send: Send) -> None:
    scope["route"] = STEPS_ROUTE
    headers = dict(scope["headers"])
    body = (await receive())["body"]  # the whole body: bounds/bodies.py has waited for it
    packed = headers.get(b"content-type", b"").lower().startswith(PACKED)
    server: Server = scope["app"].state.server
    request = await _read(server, scope, body, packed)
    answer = await server.sessions.steps.decide(_key(scope), request, scope["state"]["timing"])
    packed = accepts(headers.get(b"accept", b"").decode("latin-1"), MSGPACK)
    content = to_msgpack(answer) if packed else to_json(answer)
    told = [(b"content-length", b"%d" % len(content)), (b"content-type", PACKED if packed else JSON)]
    await send({"type": "http.response.start", "status": 200, "headers": told})
    await send({"type": "http.response.body", "body": content})


async def _read(server: Server, scope: Scope, body: bytes | str, packed: bool) -> StepBody:
    async def read() -> StepBody:
        return read_step(body, packed)

    if len(body) <= LONG_BODY:
        return read_step(body, packed)
    return await server.sessions.steps.giving_way(scope["state"]["owner"], read)


def _key(scope: Scope) -> str:
    return scoped(scope["state"]["owner"], scope["path_params"]["session_id"])


async def _serve_stream(scope: Scope, receive: Receive, send: Send) -> None:
    scope["state"]["request_id"] = secrets.token_hex(8)
    logs.request.set(scope)
    server: Server = scope["app"].state.server
    await receive()  # the handshake
    try:
        await server.sessions.read(_key(scope))
    except SpecshieldError as error:
        await problems.tell(scope, error)(scope, receive, send)
        return
    stream = _Stream(server, _key(scope), scope, send)
    server.streams.open.add(stream.stop)
    refused = asyncio.create_task(stream.stop_when_refused())
    try:
        await send({"type": "websocket.accept"})
        if server.streams.closed:  # the server was told to stop since the handshake
            stream.stop()
        await stream.serve(receive)
    finally:
        server.streams.open.discard(stream.stop)
        refused.cancel()


class _Stream:
    def __init__(self, server: Server, key: str, scope: Scope, send: Send) -> None:
        self._server, self._key, self._scope, self._send = server, key, scope, send
        self._authorization = dict(scope["headers"]).get(b"authorization", b"")
        self._busy = False
        self._ending: dict[str, Any] | None = None  # the message that closes it
        self._closing: asyncio.Future[None] | None = None

    async def serve(self, receive: Receive) -> None:
        """Answers messages until the caller leaves or `stop` is called."""
        while (message := await receive())["type"] == "websocket.receive" and self._closing is None:
            self._busy = True
            text, content = message.get("text"), message.get("bytes") or b""
            packed = text is None
            began = time.perf_counter()
            status, answer = await self._answer(content if text is None else text, packed)
            metrics.answered("STEP", STREAM_ROUTE, status, time.perf_counter() - began)
            said: dict[str, Any] = {"bytes": answer} if packed else {"text": answer.decode()}
            await self._send({"type": "websocket.send", **said})
            self._busy = False
            if self._ending is not None:
                await self._send(self._ending)
                return
        if self._closing is not None:
            await self._closing

    def stop(self, code: int = GOING_AWAY, reason: str = "the server stops") -> None:
        """Closes the stream, after the step that is being decided if there is one."""
        if self._ending is None:
            self._ending = {"type": "websocket.close", "code": code, "reason": reason}
            if not self._busy:
                self._closing = asyncio.ensure_future(self._send(self._ending))

    async def stop_when_refused(self) -> None:
        await self._server.keys.until_refused(self._authorization)
        self.stop(REFUSED, "the API key is no longer one of this server's")

    async def _answer(self, content: bytes | str, packed: bool) -> tuple[int, bytes]:
        """The status that the answer has over HTTP, and the answer as a message."""
        try:
            api_key = await self._server.keys.check(self._authorization)  # the key may have been revoked
            self._scope["state"]["rates"].take(api_key, True)
            request = await _read(self._server, self._scope, content, packed)
            answer = await self._server.sessions.steps.decide(self._key, request, defaultdict(float))
            return 200, to_msgpack(answer) if packed else to_json(answer)
        except Exception as error:
            told = problems.known(error)
            if told is not None:
                problems.tell(self._scope, told)
            else:
                log.exception("a step of a stream failed")
                told = ServerError("the server failed on this step; its log says more")
        metrics.refused(told.type)
        return problems.status_of(told), write_problem(told, packed)
