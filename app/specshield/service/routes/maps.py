"""/v1/maps: the floors that robots move on."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response

from specshield.service.bounds.bodies import received
from specshield.service.heavy.uploads import FILES
from specshield.service.schemas.base import Id
from specshield.service.schemas.specs import MapList, MapResponse
from specshield.service.state import FULL, TOO_MUCH, Caller, Cursor, Limit, Owner, ServerState, problems
from specshield.world.formats import FORMATS

router = APIRouter(prefix="/v1/maps", tags=["maps"])
MapId = Annotated[
    Id, Path(description="Id or name of a map.", openapi_examples={"case1": {"value": "case1"}})
]


def _described() -> dict[str, Any]:
    """The request body of `create` for OpenAPI: one schema for each format that is installed."""
    schemas: dict[bool, list[dict[str, Any]]] = {True: [], False: []}
    examples: dict[str, Any] = {}
    for name, format in FORMATS.usable():
        kind = {"type": "string", "format": "binary"} if format.files else {}
        properties: dict[str, Any] = {member: {**kind, **told} for member, told in format.members.items()}
        required = format.required
        if name != FILES:
            properties["format"], required = {"const": name}, [*required, "format"]
        properties["name"] = {
            "type": "string" if format.files else ["string", "null"],
            "description": "A name of your own, accepted wherever an id is.",
        }
        about = {"title": name, "description": format.about, "required": required}
        schemas[format.files].append({"type": "object", **about, "properties": properties})
        if format.example is not None and not format.files:
            examples[name] = {"value": {"format": name, **format.example}}
    content = {
        "application/json": {"schema": {"oneOf": schemas[False]}, "examples": examples},
        "multipart/form-data": {"schema": {"oneOf": schemas[True]}},
    }
    said = "A map in one of these formats: as JSON, in which `format` names the format, or as files."
    return {"requestBody": {"required": True, "description": said, "content": content}}


@router.post(
    "",
    status_code=201,
    response_model=MapResponse,
    summary="Send a map",
    responses=problems(
        _409="`name-taken`: something else of yours has the name.",
        _429="`limit-reached`: the server keeps no more maps; delete one.",
        **FULL,
        **TOO_MUCH,
    ),
    openapi_extra=_described(),
)
async def create(request: Request, server: ServerState, caller: Caller) -> Any:
    """Maps are immutable, and their id is the hash of their content: the same map sent again has the same id.
    Only the key that sent a map can use it.

    Unknown cells count as occupied, and so does everything outside the map. Formulas can name the rooms.
    """
    body = received(request)
    kept = await server.heavy.run(request, "add_map", body.content_type, body.content, caller)
    await server.store.follow()
    return kept


@router.get("", response_model=MapList, summary="List the maps", responses=problems())
async def list_all(server: ServerState, owner: Owner, cursor: Cursor = None, limit: Limit = 100) -> Any:
    """The maps that came with the server and your own, in order of name and id. A page may have fewer items
    than `limit`."""
    found, following = await asyncio.to_thread(server.maps.page, owner, cursor, limit)
    return {"items": found, "next": following}


@router.get(
    "/{map_id}", response_model=MapResponse, summary="Read a map", responses=problems(_404="No such map.")
)
async def read(map_id: MapId, server: ServerState, owner: Owner) -> Any:
    """The map's size, its place in the map frame, and its named areas."""
    return await asyncio.to_thread(server.maps.show, map_id, owner)


@router.get(
    "/{map_id}/image.png",
    response_class=Response,
    summary="See a map",
    responses={
        200: {"content": {"image/png": {}}, "description": "One pixel a cell."},
        **problems(_404="No such map.", **TOO_MUCH),
    },
)
async def image(map_id: MapId, request: Request, server: ServerState, owner: Owner) -> Response:
    """White cells are free, black ones occupied. The grid's rows are the image's, the last row at the top."""
    return Response(await server.heavy.run(request, "draw_map", map_id, owner), media_type="image/png")


@router.delete(
    "/{map_id}",
    status_code=204,
    summary="Remove a map",
    responses=problems(
        _404="No such map.", _409="`in-use`: a policy is for it (`policy_id`), or it came with the server."
    ),
)
async def delete(map_id: MapId, server: ServerState, owner: Owner) -> Response:
    """Removes the map for the key that asks. Another key that sent the same map keeps it."""
    await asyncio.to_thread(server.maps.delete, map_id, owner)
    await server.store.follow()
    return Response(status_code=204)
