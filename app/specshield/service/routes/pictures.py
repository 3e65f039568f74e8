"""Pictures of policies and sessions, as SVG files that need nothing else."""

from __future__ import annotations

import asyncio
import hashlib
from typing import Any

from fastapi import APIRouter, Request, Response

from specshield.service.routes.policies import PolicyId
from specshield.service.routes.sessions import UNREADABLE, SessionKey
from specshield.service.state import TOO_MUCH, Owner, ServerState, problems

router = APIRouter(prefix="/v1")
SVG = "image/svg+xml"
ALONE = {"Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:"}


def _drawn(said: str, **told: str) -> dict[int | str, dict[str, Any]]:
    return {200: {"content": {SVG: {"schema": {"type": "string"}}}, "description": said}, **problems(**told)}


@router.get(
    "/policies/{policy_id}/image.svg",
    tags=["policies"],
    response_class=Response,
    summary="See a policy",
    responses=_drawn("The floor, and which starts can keep the rule.", _404="No such policy.", **TOO_MUCH),
)
async def policy(policy_id: PolicyId, request: Request, server: ServerState, owner: Owner) -> Response:
    """The map, the regions of the rule, and the starts from which the rule can be kept. A place is green if
    every heading tried there has an action with a certified future, and red if no heading has one.

    The shield tries one place after the other, for some seconds. The longer its decisions take, the further
    apart the places are; the picture says how far. The server keeps the latest pictures.
    """
    found = await asyncio.to_thread(server.policies.find, policy_id, owner)
    drawn = server.pictures.peek(found.id)
    if drawn is None:
        drawn, known = await server.heavy.run(request, "pictures:draw_policy", found.id, owner)
        if known:  # otherwise the next picture may show more
            server.pictures.put(found.id, drawn)
    return _shown(request, drawn)


@router.get(
    "/sessions/{session_id}/image.svg",
    tags=["sessions"],
    response_class=Response,
    summary="See a session",
    responses=_drawn("The floor, the way driven, and the certified continuation.", **UNREADABLE),
)
async def session(key: SessionKey, request: Request, server: ServerState) -> Response:
    """The map, the regions of the rule, the way driven so far, and the certified continuation of the last
    decision.
    """
    seen = await server.sessions.last(key)
    return _shown(request, await server.heavy.run(request, "pictures:draw_session", *seen))


def _shown(request: Request, drawn: bytes) -> Response:
    tag = f'"{hashlib.sha256(drawn).hexdigest()[:32]}"'
    headers = {**ALONE, "ETag": tag, "Cache-Control": "private, no-cache"}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    return Response(drawn, media_type=SVG, headers=headers)
