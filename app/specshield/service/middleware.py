"""The middlewares of every request: who may ask, request ids, Server-Timing, metrics, and a line of the log
for a refused request. They are plain ASGI, since Starlette's `@app.middleware` costs most of the throughput.
"""

from __future__ import annotations

import itertools
import re
import secrets
import time
from collections import defaultdict

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from specshield.errors import NotFound, SpecshieldError, Stopping
from specshield.service import metrics, problems
from specshield.service.access.keys import Rates
from specshield.service.access.site import Headers, check_site, headers_of
from specshield.service.routes.steps import STREAM
from specshield.service.watch import logs

REQUEST_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}")
STARTED = secrets.token_hex(6)  # begins the ids of this process: new random bytes would take 5 % of a step
_count = itertools.count(1)


class Observe:
    """Request ids, Server-Timing, metrics. Routes add their parts [s] to `scope["state"]["timing"]`."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        start = time.perf_counter()
        timing = defaultdict[str, float](float)
        scope.setdefault("state", {})["timing"] = timing
        asked = next((v for n, v in scope["headers"] if n == b"x-request-id"), b"").decode("latin-1")
        request_id = asked if REQUEST_ID.fullmatch(asked) else f"{STARTED}{next(_count):08x}"
        scope["state"]["request_id"] = request_id
        logs.request.set(scope)
        status, begun = 500, False

        async def answer(message: Message) -> None:
            nonlocal status, begun
            if message["type"] == "http.response.start":
                status, begun = message["status"], True
                parts = {"total": time.perf_counter() - start, **timing}
                told = ", ".join([f"{name};dur={1000 * dur:.3f}" for name, dur in parts.items()])
                own = ((b"x-request-id", request_id.encode()), (b"server-timing", told.encode()))
                message = {**message, "headers": [*message.get("headers", ()), *own]}
            await send(message)

        try:
            await self.app(scope, receive, answer)
        except Exception as error:
            told, late = problems.known(error), begun
            if not late:
                response = problems.failed() if told is None else problems.tell(scope, told)
                await response(scope, receive, answer)
            if late or told is None:
                raise
        finally:
            status = scope["state"].get("status", status)  # set if the caller has left
            route = getattr(scope.get("route"), "path", "other")
            method = scope["method"] if route != "other" else "other"  # callers may make up methods and paths
            metrics.answered(method, route, status, time.perf_counter() - start)
            if status >= 400:
                type = scope["state"].get("problem", "error")
                metrics.refused(type)
                if status < 500:  # a failure has been logged already
                    logs.tell("refused", type=type, status=status, method=method, route=route)


class Guard:
    """Refuses requests by address, page and API key, and all of them while the server is starting.

    It does so before anything of a body is read, and with the same answers for handshakes of WebSockets. It
    writes into `scope["state"]`: `key`, its name as `owner`, and `rates`, which count the key's requests.
    """

    def __init__(self, app: ASGIApp, allowed_hosts: frozenset[str]) -> None:
        self.app, self._allowed, self._rates = app, allowed_hosts, Rates()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            scope.setdefault("state", {})
            try:
                await self._check(scope, headers_of(scope["headers"]))
            except SpecshieldError as error:
                await problems.ProblemResponse(error)(scope, receive, send)
                return
        await self.app(scope, receive, send)

    async def _check(self, scope: Scope, headers: Headers) -> None:
        check_site(scope, headers, self._allowed)
        path, server = scope["path"], scope["app"].state.server
        # A newline at the end has to be refused here: `$` in a route's pattern would match before it.
        if path.endswith("\n") or (scope["type"] == "websocket" and STREAM.fullmatch(path) is None):
            raise NotFound(f"there is no {path!r} here", got=path, expected="a path listed at /docs")
        if guarded(path):
            key = await server.keys.check(headers.get(b"authorization", b""))
            self._rates.take(key, path.endswith(("/steps", "/stream")))
            scope["state"].update(key=key, owner=key.name, rates=self._rates)
        starting = server.startup.problem() if path.startswith("/v1/") else None
        if starting is not None and not isinstance(starting, Stopping):
            raise starting


def guarded(path: str) -> bool:
    """Whether a path needs the key, where there is one."""
    return path.startswith("/v1/") or path == "/metrics"
