"""Who may ask: by the address, the page that asks, and the API key; and whether the server is ready."""

from __future__ import annotations

from starlette.types import ASGIApp, Receive, Scope, Send

from specshield.errors import NotFound, SpecshieldError, Stopping
from specshield.service import problems
from specshield.service.access.rates import Rates
from specshield.service.access.site import check_site


class Guard:
    """Refuses before anything of a body is read, and handshakes of WebSockets by the same rules and answers.
    `scope["state"]` says who asks: `key`, its name as `owner`, and `rates`, which count what it asks.
    """

    def __init__(self, app: ASGIApp, allowed_hosts: frozenset[str]) -> None:
        self.app, self._allowed, self._rates = app, allowed_hosts, Rates()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            scope.setdefault("state", {})
            try:
                await self._check(scope, dict(scope["headers"]))
            except SpecshieldError as error:
                await problems.response(error)(scope, receive, send)
                return
        await self.app(scope, receive, send)

    async def _check(self, scope: Scope, headers: dict[bytes, bytes]) -> None:
        check_site(scope, headers, self._allowed)
        path, server = scope["path"], scope["app"].state.server
        if path.endswith("\n"):  # a route's pattern would take it: `$` stands before a last newline too
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
