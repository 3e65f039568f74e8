"""Request ids, Server-Timing, metrics, and a line of the log for what is refused."""

from __future__ import annotations

import itertools
import re
import secrets
import time
from collections import defaultdict

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from specshield.service import metrics, problems
from specshield.service.watch import logs

REQUEST_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}")
STARTED = secrets.token_hex(6)  # of this process; to ask for random bytes takes 5 % of a step
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
        except Exception:
            if not begun:
                await problems.failed()(scope, receive, answer)
            raise
        finally:
            status = scope["state"].get("status", status)  # of a request that nobody waits for any more
            route = getattr(scope.get("route"), "path", "other")
            method = scope["method"] if route != "other" else "other"  # what a caller makes up is no label
            metrics.answered(method, route, status, time.perf_counter() - start)
            if status >= 400:
                type = scope["state"].get("problem", "error")
                metrics.refused(type)
                if status < 500:  # what failed has a line already that says more
                    logs.tell("refused", type=type, status=status, method=method, route=route)
