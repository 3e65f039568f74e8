"""What is shown of a session to others: `/v1/sessions/{id}/events`, each decision as it is made, as
server-sent events; and `/v1/sessions/{id}/record`, all of it, to be verified.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, Header, Query, Response
from pydantic import Field
from starlette.types import Receive, Scope, Send

from specshield.errors import StoreError
from specshield.service import examples
from specshield.service.access.owners import Owner, scoped
from specshield.service.problems import until_gone
from specshield.service.routes.sessions import GONE, PathId, SessionKey
from specshield.service.schemas.base import ID
from specshield.service.sessions import chain
from specshield.service.state import ServerState, problems

EVENTS = "text/event-stream"
router = APIRouter(prefix="/v1", tags=["sessions"])


class EventStream(Response):
    """Sends what the stream gives until it ends, its key is refused, the store is away or the reader gone."""

    media_type = EVENTS

    def __init__(self, stream: AsyncIterator[bytes]) -> None:
        super().__init__(headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})
        del self.headers["content-length"]
        self._stream = stream

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def end_after(event: Callable[[Any], Awaitable[None]], about: Any) -> None:
            await event(about)
            reading.cancel()

        shown = dict(scope["headers"]).get(b"authorization", b"")
        await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
        async with anyio.create_task_group() as group:
            with anyio.CancelScope() as reading, suppress(StoreError):
                group.start_soon(end_after, until_gone, receive)
                group.start_soon(end_after, scope["app"].state.server.keys.until_refused, shown)
                async for content in self._stream:
                    await send({"type": "http.response.body", "body": content, "more_body": True})
            await send({"type": "http.response.body", "body": b""})
            group.cancel_scope.cancel()
        await self._stream.aclose()  # type: ignore[attr-defined]


EVENT = {  # of each in the stream
    "type": "object",
    "required": ["data"],
    "properties": {"id": {"type": "string"}, "event": {"type": "string"}, "data": {"type": "string"}},
}


@router.get(
    "/sessions/{session_id}/events",
    response_class=Response,
    summary="Watch a session",
    responses={
        200: {
            "content": {EVENTS: {"schema": EVENT}},
            "description": "Server-sent events: `id` is t, `data` the answer to that step, as JSON. The last "
            "one is `event: end`. Comments keep the connection alive.",
        },
        204: {"description": "The session is over, and nothing follows: do not ask again."},
        **problems(**GONE, _429="The server has no room for more streams."),
    },
)
async def events(
    key: SessionKey,
    server: ServerState,
    last_event_id: Annotated[
        int | None, Header(ge=-1, le=1_000_000, description="As `after`; a browser sends it by itself.")
    ] = None,
    after: Annotated[
        int | None, Query(ge=-1, le=1_000_000, description="Begin after this step; -1: with the first.")
    ] = None,
) -> Response:
    """Each decision as it is made, whichever server makes it, about a tenth of a second later.

    Without `after` or `Last-Event-ID` it begins with the next decision; with one of them it resumes where the
    reader was, without a gap and without doubles. Steps that were passed over have no event. The stream ends
    when the session is finished, when its key is revoked, and when this server stops: then ask again. A
    reader who is too slow is cut off.
    """
    stream = await server.watchers.open(key, after if last_event_id is None else last_event_id)
    return Response(status_code=204) if stream is None else EventStream(stream)


@router.get(
    "/sessions/{session_id}/record",
    response_class=Response,
    summary="Read the record",
    responses={
        200: {
            "content": {chain.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}},
            "description": "A file for `specshield verify`. `X-Record-Seal` is its seal.",
        },
        **problems(**GONE),
    },
)
async def read_record(key: SessionKey, session_id: PathId, server: ServerState) -> Response:
    """The session's config, poses, signals, what was asked and answered at each step: a chain of hashes.

    `specshield verify` checks the chain, and decides every step again, to the same bytes.
    """
    content, seal = await server.sessions.record(key)
    name = f'attachment; filename="{session_id}.record"'
    headers = {"Content-Disposition": name, "X-Record-Seal": seal}
    return Response(content, media_type=chain.MEDIA_TYPE, headers=headers)


MOST_SESSIONS = 64  # of one stream; chosen by hand: a page of more is not read
PLACE = rf"^{ID}(:(-1|[0-9]{{1,7}}))?$"
Places = Annotated[
    list[Annotated[str, Field(pattern=PLACE)]],
    Query(
        min_length=1,
        max_length=MOST_SESSIONS,
        openapi_examples={"example": {"value": [f"{examples.SESSION['id']}:-1"]}},
        description="Ids of sessions; `id:41` begins after step 41, `id:-1` with the first, `id` now.",
    ),
]


@router.get(
    "/events",
    response_class=Response,
    summary="Watch several sessions",
    responses={
        200: {
            "content": {EVENTS: {"schema": EVENT}},
            "description": "Server-sent events: `data` is `session`, `t`, `pose`, `logits`, `decision`, as "
            "in a trajectory; the last one of a session is `session`, `finished` and `spec_status`.",
        },
        **problems(_429="The server has no room for more streams."),
    },
)
async def several(server: ServerState, owner: Owner, session: Places) -> Response:
    """What several robots do, in one stream: what a page needs to show them on one floor.

    Sessions that are not there are left out. The stream ends when all of them are over.
    """
    asked = (place.partition(":") for place in session)
    after = {scoped(owner, id): int(t) if t else None for id, _, t in asked}
    return EventStream(await server.watchers.open_all(after))
