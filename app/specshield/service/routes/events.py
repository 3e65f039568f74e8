"""Routes for those who watch or check a session that somebody else steps: `/v1/sessions/{id}/events` and
`/v1/events` stream decisions as they are made, `/v1/sessions/{id}/record` is the file that can be verified.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, Header, Query, Response
from pydantic import Field
from starlette.types import Receive, Scope, Send

from specshield.errors import SessionDamaged, StoreError
from specshield.service import examples
from specshield.service.problems import until_gone
from specshield.service.routes.sessions import UNREADABLE, PathId, SessionKey
from specshield.service.schemas.base import ID
from specshield.service.sessions import chain
from specshield.service.state import Owner, ServerState, problems
from specshield.service.storage.store import scoped

EVENTS = "text/event-stream"
router = APIRouter(prefix="/v1", tags=["sessions"])


class EventStream(Response):
    """Sends the stream until it ends, the caller's key is refused, what it tells cannot be read or the caller
    leaves.
    """

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
            with anyio.CancelScope() as reading, suppress(StoreError, SessionDamaged):
                group.start_soon(end_after, until_gone, receive)
                group.start_soon(end_after, scope["app"].state.server.keys.until_refused, shown)
                async for content in self._stream:
                    await send({"type": "http.response.body", "body": content, "more_body": True})
            await send({"type": "http.response.body", "body": b""})
            group.cancel_scope.cancel()
        await self._stream.aclose()  # type: ignore[attr-defined]


EVENT = {  # the schema of one event
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
            "description": "Server-sent events: `id` is t, `data` the answer to that step as JSON. The last "
            "event is `event: end`. Comments keep the connection alive.",
        },
        204: {"description": "The session is over and has no further event: do not ask again."},
        **problems(**UNREADABLE, _429="`limit-reached`: the server has no room for more streams."),
    },
)
async def events(
    key: SessionKey,
    server: ServerState,
    owner: Owner,
    last_event_id: Annotated[
        int | None, Header(ge=-1, le=1_000_000, description="The same as `after`; browsers send it.")
    ] = None,
    after: Annotated[
        int | None, Query(ge=-1, le=1_000_000, description="Begin after this step; -1: at the first step.")
    ] = None,
) -> Response:
    """Each decision, about a tenth of a second after it was made, whichever server made it.

    Without `after` and `Last-Event-ID` the stream begins with the next decision. With one of them it begins
    after that step, with no decision left out and none sent twice. Steps without a decision have no event.
    The stream ends when the session is finished, when the caller's key is revoked, and when this server
    stops. After a stop, ask again. A caller who reads too slowly is cut off.
    """
    stream = await server.watchers.open(key, after if last_event_id is None else last_event_id, owner)
    return Response(status_code=204) if stream is None else EventStream(stream)


@router.get(
    "/sessions/{session_id}/record",
    response_class=Response,
    summary="Read the record",
    responses={
        200: {
            "content": {chain.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}},
            "description": "A file for `specshield verify`.",
            "headers": {"X-Record-Seal": {"description": "The record's seal.", "schema": {"type": "string"}}},
        },
        **problems(**UNREADABLE),
    },
)
async def read_record(key: SessionKey, session_id: PathId, server: ServerState) -> Response:
    """The session's settings, poses and signals, and the request and the answer of each step, in a chain of
    hashes.

    `specshield verify` checks the chain and makes every decision again, to the same bytes.
    """
    content, seal = await server.sessions.record(key)
    name = f'attachment; filename="{session_id}.record"'
    headers = {"Content-Disposition": name, "X-Record-Seal": seal}
    return Response(content, media_type=chain.MEDIA_TYPE, headers=headers)


MOST_SESSIONS = 64  # in one stream; chosen by hand: nobody can follow more on one page
PLACE = rf"^{ID}(:(-1|[0-9]{{1,7}}))?$"
Places = Annotated[
    list[Annotated[str, Field(pattern=PLACE)]],
    Query(
        min_length=1,
        max_length=MOST_SESSIONS,
        openapi_examples={"example": {"value": [f"{examples.SESSION['id']}:-1"]}},
        description="Ids of sessions; `id:41` begins after step 41, `id:-1` at the first step, `id` with the "
        "next decision.",
    ),
]


@router.get(
    "/events",
    response_class=Response,
    summary="Watch several sessions",
    responses={
        200: {
            "content": {EVENTS: {"schema": EVENT}},
            "description": "Server-sent events: `data` has `session`, `t`, `pose`, `logits`, `decision`, as "
            "in a trajectory; in the last event of a session, `session`, `finished` and `spec_status`.",
        },
        **problems(_429="`limit-reached`: the server has no room for more streams."),
    },
)
async def several(server: ServerState, owner: Owner, session: Places) -> Response:
    """The decisions of several sessions in one stream, as a page needs them to show robots on one floor.

    Sessions that do not exist or cannot be read are left out. The stream ends when all of them are over.
    """
    asked = (place.partition(":") for place in session)
    after = {scoped(owner, id): int(t) if t else None for id, _, t in asked}
    return EventStream(await server.watchers.open_all(after, owner))
