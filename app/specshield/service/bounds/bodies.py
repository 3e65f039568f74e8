"""Receives the body of each request within limits, before the application sees the request.

So no route waits for bytes, a request whose client leaves in the middle of the body has no effect, and large
bodies are on the disk for the process that parses them.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from specshield.errors import BodyTooLarge, InputError, RequestTimeout, SpecshieldError
from specshield.service import problems
from specshield.service.access.site import UPLOADS
from specshield.service.bounds.body import FREE, Body, Budget
from specshield.service.bounds.protocol import ARRIVED
from specshield.service.problems import CLIENT_GONE
from specshield.service.settings import Settings

LONG = ("/steps", "/close", "/switch", "/validate")  # bodies with a history, or a formula with regions
LONG_JSON = 16 << 10  # [bytes]; a shorter body has no room for many members


class Bodies:
    """Puts the `Body` of an upload into `scope["state"]["body"]`; other routes get theirs in one message."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        self._folder = settings.data_dir / "incoming"
        self._budget = Budget(settings.max_bodies_bytes)
        self._max_body, self._max_upload = settings.max_body_bytes, settings.max_upload_bytes
        self._members, self._patience = settings.max_body_members, settings.request_timeout
        self._slowest, self._short = settings.min_body_rate, min(settings.max_body_bytes, LONG_JSON)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or not _has_body(scope):
            await self.app(scope, receive, send)
            return
        path = scope["path"].rstrip("/")
        upload = path in UPLOADS
        announced = _header(scope, b"content-length")
        if ARRIVED in scope["state"] and not upload and announced.isdigit() and int(announced) <= self._short:
            await self._pass_on(scope, receive, send)  # nearly every step: too short for the limits below
            return
        body = Body(self._budget, self._folder, _header(scope, b"content-type"))
        try:
            try:
                if not await self._take_in(scope, receive, body, self._limit(path)):
                    scope["state"]["status"] = CLIENT_GONE
                    return
                if not upload:
                    self._check_members(body.content)
            except SpecshieldError as error:
                # The rest of the body is not read.
                await problems.ProblemResponse(error, {"Connection": "close"})(scope, receive, send)
                return
            if upload:
                scope["state"]["body"] = body
                await self.app(scope, receive, send)
            else:
                await self.app(scope, _replay(body.content, receive), send)
        finally:
            body.close()

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes on a request whose body has arrived in one piece."""
        message = await receive()
        if message["type"] == "http.disconnect":
            scope["state"]["status"] = CLIENT_GONE
            return
        await self.app(scope, _replay(message.get("body", b""), receive), send)

    def _limit(self, path: str) -> int:
        if path in UPLOADS:
            return self._max_upload
        return self._max_body if path.endswith(LONG) else min(self._max_body, FREE)

    async def _take_in(self, scope: Scope, receive: Receive, body: Body, limit: int) -> bool:
        """Receives a body of at most `limit` bytes. False if the client has left."""
        announced = _header(scope, b"content-length") or "0"
        if announced.isdigit() and int(announced) > limit:
            raise _too_large(limit)
        loop = asyncio.get_running_loop()
        begun = loop.time()
        try:
            async with asyncio.timeout_at(begun + self._patience) as deadline:
                while True:
                    message = await receive()
                    if message["type"] == "http.disconnect":
                        return False
                    chunk = message.get("body", b"")
                    if body.size + len(chunk) > limit:
                        raise _too_large(limit)
                    await body.add(chunk)
                    if not message.get("more_body", False):
                        await body.end()
                        return True
                    deadline.reschedule(begun + self._patience + body.size / self._slowest)
        except TimeoutError:
            raise RequestTimeout(
                f"the body took too long: {body.size} bytes came in {loop.time() - begun:.0f} s",
                expected=f"all of it within {self._patience:g} s and 1 s more for each {self._slowest} bytes",
            ) from None

    def _check_members(self, content: bytes | Path) -> None:
        """Raises InputError for too many members: a schema makes an error for each unknown one."""
        if isinstance(content, bytes) and len(content) > LONG_JSON and content.count(b":") > self._members:
            raise InputError(
                "the body has too many members",
                path="body",
                got=content.count(b":"),
                expected=f"at most {self._members}, where colons in texts count too",
            )


def _too_large(limit: int) -> BodyTooLarge:
    return BodyTooLarge("the body is too large", expected=f"at most {limit} bytes", limit=limit)


def _replay(content: bytes | Path, receive: Receive) -> Receive:
    """A `receive` that gives the body in one message, and then waits until the client leaves."""
    given = False

    async def replay() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        whole = content if isinstance(content, bytes) else await asyncio.to_thread(content.read_bytes)
        return {"type": "http.request", "body": whole, "more_body": False}

    return replay


def _has_body(scope: Scope) -> bool:
    return scope["method"] in ("POST", "PUT", "PATCH") or any(
        name in (b"content-length", b"transfer-encoding") for name, _ in scope["headers"]
    )


def _header(scope: Scope, wanted: bytes) -> str:
    return next((value.decode("latin-1") for name, value in scope["headers"] if name == wanted), "")
