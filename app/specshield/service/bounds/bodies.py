"""Receives the body of each request within limits, before the application sees the request.

So no route waits for bytes, a request whose client leaves in the middle of the body has no effect, and large
bodies are on the disk for the process that parses them. A budget limits all bodies together.
"""

from __future__ import annotations

import asyncio
import contextlib
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from specshield.errors import BodyTooLarge, Busy, InputError, RequestTimeout, SpecshieldError
from specshield.service import problems
from specshield.service.access.site import UPLOADS, WITH_BODY
from specshield.service.bounds.protocol import ARRIVED, FREE
from specshield.service.problems import CLIENT_GONE
from specshield.service.settings import Settings
from specshield.service.storage.objects import unusable

LONG = ("/steps", "/close", "/switch", "/validate")  # bodies with a history, or a formula with regions
IN_MEMORY = 1 << 20  # [bytes] of a body that are held in memory before they are written to its file
MOST_ITEMS = 50_000  # of JSON with a history; the longest step has 10,001 poses and 4,000 points: 38,500
LONG_JSON = 16 << 10  # [bytes]; a shorter body has no room for many members


class Budget:
    """The bytes that the bodies of all requests together may have."""

    def __init__(self, limit: int) -> None:
        self._left = limit

    def take(self, size: int) -> None:
        """Raises Busy if so many bytes are not left."""
        if size > self._left:
            raise Busy(
                "the server cannot hold more bytes of requests now", expected="the request again in a while"
            )
        self._left -= size

    def give(self, size: int) -> None:
        self._left += size


@dataclass
class Body:
    """folder: for the file of a large body. `close` removes the file and gives the bytes back."""

    budget: Budget
    folder: Path
    content_type: str
    size: int = 0
    _held: bytearray = field(default_factory=bytearray)
    _file: Any = None

    async def add(self, chunk: bytes) -> None:
        """Raises Busy if the bodies of all requests together have too many bytes, and InsufficientStorage or
        StoreError if the file cannot be written.
        """
        counted = max(self.size - FREE, 0)
        self.budget.take(max(self.size + len(chunk) - FREE, 0) - counted)
        self.size += len(chunk)
        self._held += chunk
        if len(self._held) > IN_MEMORY:
            await self._write()

    async def end(self) -> None:
        """To be called after the last `add`."""
        if self._file is not None:
            await self._write()

    @property
    def content(self) -> bytes | Path:
        """The whole body, or the file that holds it."""
        return bytes(self._held) if self._file is None else Path(self._file.name)

    async def _write(self) -> None:
        held, self._held = self._held, bytearray()
        try:
            await asyncio.to_thread(self._append, held)
        except OSError as error:
            raise unusable(error) from error

    def _append(self, content: bytearray) -> None:
        if self._file is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._file = tempfile.NamedTemporaryFile(dir=self.folder)  # noqa: SIM115  it stays open until `close`
        self._file.write(content)
        self._file.flush()

    def close(self) -> None:
        self.budget.give(max(self.size - FREE, 0))
        self.size = 0
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()  # which removes it


class Bodies:
    """Puts the `Body` of an upload into `scope["state"]["body"]`; other routes get theirs in one message."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app, self._settings, self._budget = app, settings, Budget(settings.max_bodies_bytes)
        self._folder, self._short = settings.data_dir / "incoming", min(settings.max_body_bytes, LONG_JSON)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers: dict[bytes, bytes] = dict(scope.get("headers", ()))
        framed = b"content-length" in headers or b"transfer-encoding" in headers
        if scope["type"] != "http" or not (framed or scope["method"] in WITH_BODY):
            await self.app(scope, receive, send)
            return
        path = scope["path"].rstrip("/")
        upload = path in UPLOADS
        announced = headers.get(b"content-length", b"")
        if ARRIVED in scope["state"] and not upload and announced.isdigit() and int(announced) <= self._short:
            await self._pass_on(scope, receive, send)  # nearly every step: too short for the limits below
            return
        body = Body(self._budget, self._folder, headers.get(b"content-type", b"").decode("latin-1"))
        try:
            try:
                limit = self._limit(path)
                if announced.isdigit() and int(announced) > limit:
                    raise _too_large(limit)
                if not await self._take_in(receive, body, limit):
                    scope["state"]["status"] = CLIENT_GONE
                    return
                if not upload:
                    _check_members(body.content, self._settings.max_body_members)
                    if path.endswith(("/close", "/switch")) and isinstance(body.content, bytes):
                        check_items(body.content)
            except SpecshieldError as error:
                # The rest of the body is not read.
                await problems.ProblemResponse(error, {"Connection": "close"})(scope, receive, send)
                return
            if upload:
                scope["state"]["body"] = body
                await self.app(scope, receive, send)
            elif body.size > FREE and path.endswith(("/close", "/switch")):
                turns, owner = scope["app"].state.server.sessions.steps.long_requests, scope["state"]["owner"]
                await turns.having(owner, self.app, scope, _replay(body.content, receive), send)
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
        if path in UPLOADS:  # a larger one than all together may have would have to wait for ever
            return min(self._settings.max_upload_bytes, self._settings.max_bodies_bytes)
        most = self._settings.max_body_bytes
        return most if path.endswith(LONG) else min(most, FREE)

    async def _take_in(self, receive: Receive, body: Body, limit: int) -> bool:
        """Receives a body of at most `limit` bytes. False if the client has left."""
        loop, patience = asyncio.get_running_loop(), self._settings.request_timeout
        begun, slowest = loop.time(), self._settings.min_body_rate
        try:
            async with asyncio.timeout_at(begun + patience) as deadline:
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
                    deadline.reschedule(begun + patience + body.size / slowest)
        except TimeoutError:
            raise RequestTimeout(
                f"the body took too long: {body.size} bytes came in {loop.time() - begun:.0f} s",
                expected=f"all of it within {patience:g} s and 1 s more for each {slowest} bytes",
            ) from None


def received(request: Request) -> Body:
    """The body of an upload, which bodies.py has received."""
    body: Body = request.scope["state"]["body"]
    return body


def clear(folder: Path) -> None:
    """Removes files that are older than an hour: they are left from servers that were killed."""
    for path in folder.glob("*"):
        with contextlib.suppress(OSError):
            if path.stat().st_mtime < time.time() - 3600:
                path.unlink()


def _check_members(content: bytes | Path, most: int) -> None:
    """Raises InputError for too many members: a schema makes an error for each unknown one."""
    if isinstance(content, bytes) and len(content) > LONG_JSON and content.count(b":") > most:
        raise InputError(
            "the body has too many members",
            path="body",
            got=content.count(b":"),
            expected=f"at most {most}, where colons in texts count too",
        )


def check_items(content: bytes | str) -> None:
    """Raises InputError for JSON with more items than any step has: to read 300,000 lists takes 0.5 s."""
    items = content.count(",") if isinstance(content, str) else content.count(b",")
    if items > MOST_ITEMS:
        expected = f"at most {MOST_ITEMS}, where commas in texts count too"
        raise InputError("the body has too many items", path="body", got=items, expected=expected)


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
