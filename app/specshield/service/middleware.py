"""Around every request, as plain ASGI (Starlette's `@app.middleware` costs most of the throughput)."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import time

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from specshield.errors import BodyTooLarge, Starting, Unauthorized
from specshield.service import metrics, problems

REQUEST_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}")
UPLOADS = ("/v1/maps", "/v1/policies")


class Observe:
    """Request ids, Server-Timing, metrics. Routes add their parts [s] to `scope["state"]["timing"]`."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        start = time.perf_counter()
        timing: dict[str, float] = {}
        scope.setdefault("state", {})["timing"] = timing
        asked = Headers(scope=scope).get("x-request-id", "")
        request_id = asked if REQUEST_ID.fullmatch(asked) else secrets.token_hex(8)
        status = 500

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-Id"] = request_id
                parts = {"total": time.perf_counter() - start, **timing}
                headers["Server-Timing"] = ", ".join(
                    f"{name};dur={1000 * dur:.3f}" for name, dur in parts.items()
                )
            await send(message)

        try:
            await self.app(scope, receive, answer)
        finally:
            route = getattr(scope.get("route"), "path", "other")
            method = scope["method"] if route != "other" else "other"  # what a caller makes up is no label
            metrics.requests.labels(method, route, status).inc()
            metrics.request_seconds.labels(method, route).observe(time.perf_counter() - start)


class Guard:
    """The API key, where one is asked for, whether the server is ready, and the size of bodies, also of
    chunked ones.
    """

    def __init__(self, app: ASGIApp, api_key: str | None, max_body: int, max_upload: int) -> None:
        self.app, self._max_body, self._max_upload = app, max_body, max_upload
        self._key = None if api_key is None else _hash(api_key)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        path, headers = scope["path"], Headers(scope=scope)
        if self._key is not None and guarded(path):
            scheme, _, given = headers.get("authorization", "").partition(" ")
            if scheme.lower() != "bearer" or not hmac.compare_digest(_hash(given.strip()), self._key):
                error = Unauthorized("an API key is needed", path="Authorization", expected="Bearer <key>")
                await problems.response(error)(scope, receive, send)
                return
        starting = scope["app"].state.server.startup.problem() if path.startswith("/v1/") else None
        if isinstance(starting, Starting):
            await problems.response(starting)(scope, receive, send)
            return
        limit = self._max_upload if path.rstrip("/") in UPLOADS else self._max_body
        too_large = problems.response(
            BodyTooLarge("the body is too large", expected=f"at most {limit} bytes", limit=limit)
        )
        length = headers.get("content-length", "0")
        if length.isdigit() and int(length) > limit:
            await too_large(scope, receive, send)
            return
        read, answered = 0, False

        async def count() -> Message:
            nonlocal read
            message = await receive()
            read += len(message.get("body", b""))
            return {"type": "http.disconnect"} if read > limit else message

        async def answer(message: Message) -> None:
            nonlocal answered
            if read > limit and not answered:
                return  # what the app says of a body cut short
            answered = True
            await send(message)

        try:
            await self.app(scope, count, answer)
        except Exception:
            if read <= limit:
                raise
        if read > limit and not answered:
            await too_large(scope, receive, send)


def guarded(path: str) -> bool:
    """Whether a path needs the key, where there is one."""
    return path.startswith("/v1/") or path == "/metrics"


def _hash(text: str) -> bytes:
    """Of one length whatever was sent, so that the time to compare tells nothing."""
    return hashlib.sha256(text.encode()).digest()
