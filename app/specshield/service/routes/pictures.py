"""Pictures of policies and sessions, by address: SVG that stands alone."""

from __future__ import annotations

import asyncio
import hashlib
from typing import Any

from fastapi import APIRouter, Request, Response

from specshield.service.access.owners import Owner
from specshield.service.routes.policies import PolicyId
from specshield.service.routes.sessions import GONE, SessionKey
from specshield.service.state import TOO_MUCH, ServerState, problems

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
    responses=_drawn("The floor, and from where the rule can be kept.", _404="No such policy.", **TOO_MUCH),
)
async def policy(policy_id: PolicyId, request: Request, server: ServerState, owner: Owner) -> Response:
    """The map, the regions of the rule, and from where the rule can still be kept at t = 0: green where some
    first action has a certified future from every heading that was looked at, red where none has from any.

    The shield is asked place by place, for some seconds. The longer its decisions take, the further apart
    the places are, and the picture says how far. The server keeps the pictures asked for last.
    """
    found = await asyncio.to_thread(server.policies.find, policy_id, owner)
    drawn = server.pictures.peek(found.id)
    if drawn is None:
        drawn, known = await server.heavy.run(request, "pictures:draw_policy", found.id, owner)
        if known:  # else it may look otherwise
            server.pictures.put(found.id, drawn)
    return _shown(request, drawn)


@router.get(
    "/sessions/{session_id}/image.svg",
    tags=["sessions"],
    response_class=Response,
    summary="See a session",
    responses=_drawn("The floor, the way driven, and the certified continuation.", **GONE),
)
async def session(key: SessionKey, request: Request, server: ServerState) -> Response:
    """The map, the regions of the rule, the way driven so far, and where the last decision's certified
    continuation leads.
    """
    seen = await server.sessions.last(key)
    return _shown(request, await server.heavy.run(request, "pictures:draw_session", *seen))


def _shown(request: Request, drawn: bytes) -> Response:
    tag = f'"{hashlib.sha256(drawn).hexdigest()[:32]}"'
    headers = {**ALONE, "ETag": tag, "Cache-Control": "private, no-cache"}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    return Response(drawn, media_type=SVG, headers=headers)
