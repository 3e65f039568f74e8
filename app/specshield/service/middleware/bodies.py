"""The size of bodies, also of chunked ones."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from specshield.errors import BodyTooLarge
from specshield.service import problems
from specshield.service.access.site import UPLOADS


class Bodies:
    """Refuses a body over the limit of its path [bytes]: as it is announced, or as it comes in."""

    def __init__(self, app: ASGIApp, max_body: int, max_upload: int) -> None:
        self.app, self._max_body, self._max_upload = app, max_body, max_upload

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = self._max_upload if scope["path"].rstrip("/") in UPLOADS else self._max_body
        too_large = problems.response(
            BodyTooLarge("the body is too large", expected=f"at most {limit} bytes", limit=limit)
        )
        length = Headers(scope=scope).get("content-length", "0")
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
