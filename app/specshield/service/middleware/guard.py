"""Who may ask: by the address, the page that asks, and the API key; and whether the server is ready."""

from __future__ import annotations

import hashlib
import hmac

from starlette.types import ASGIApp, Receive, Scope, Send

from specshield.errors import SpecshieldError, Starting, Unauthorized
from specshield.service import problems
from specshield.service.access.site import check_site


class Guard:
    """Refuses before anything of a body is read. WebSocket handshakes obey the same rules, and are refused
    with the same answers.
    """

    def __init__(self, app: ASGIApp, api_key: str | None, allowed_hosts: frozenset[str]) -> None:
        self.app, self._allowed = app, allowed_hosts
        self._key = None if api_key is None else _hash(api_key)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            try:
                self._check(scope, dict(scope["headers"]))
            except SpecshieldError as error:
                await problems.response(error)(scope, receive, send)
                return
        await self.app(scope, receive, send)

    def _check(self, scope: Scope, headers: dict[bytes, bytes]) -> None:
        check_site(scope, headers, self._allowed)
        path = scope["path"]
        if self._key is not None and guarded(path):
            scheme, _, given = headers.get(b"authorization", b"").partition(b" ")
            if scheme.lower() != b"bearer" or not hmac.compare_digest(_hash(given.strip()), self._key):
                raise Unauthorized("an API key is needed", path="Authorization", expected="Bearer <key>")
        starting = scope["app"].state.server.startup.problem() if path.startswith("/v1/") else None
        if isinstance(starting, Starting):
            raise starting


def guarded(path: str) -> bool:
    """Whether a path needs the key, where there is one."""
    return path.startswith("/v1/") or path == "/metrics"


def _hash(text: str | bytes) -> bytes:
    """Of one length whatever was sent, so that the time to compare tells nothing."""
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).digest()
