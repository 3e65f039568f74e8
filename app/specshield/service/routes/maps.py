"""/v1/maps: the floors that robots move on."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response
from pydantic import TypeAdapter

from specshield.errors import MapError
from specshield.service import examples
from specshield.service.library.maps import Map
from specshield.service.routes import uploads
from specshield.service.schemas import GridMap, HouseMap, Id, MapList, MapResponse, MapUpload
from specshield.service.state import Cursor, Limit, Server, ServerState, problems
from specshield.world.map_server import from_occupancy_grid, load_map
from specshield.world.procthor import load_house

router = APIRouter(prefix="/v1/maps", tags=["maps"])
MODELS = (HouseMap, GridMap)  # documented by hand
UPLOAD: TypeAdapter[HouseMap | GridMap] = TypeAdapter(MapUpload)
MapId = Annotated[
    Id, Path(description="Id or name of a map.", openapi_examples={"case1": {"value": "case1"}})
]


@router.post(
    "",
    status_code=201,
    response_model=MapResponse,
    summary="Send a map",
    responses=problems(_429="The server keeps no more maps."),
    openapi_extra=uploads.request_body(
        "A map_server map as two files, or JSON: a ProcTHOR house or a nav_msgs/OccupancyGrid.",
        UPLOAD,
        examples.GRID_MAP,
        {"metadata": "The map_server YAML; its `image:` is ignored.", "image": "The image: PGM or PNG."},
    ),
)
async def create(request: Request, server: ServerState) -> Any:
    """Maps are immutable and known by the hash of their content: the same map again is the one there is.

    Outside the map everything is occupied, and so is what is unknown. In a ProcTHOR house map (x, y) is the
    house's (x, z), theta = pi/2 - yaw, and its rooms become names for formulas.
    """
    if uploads.is_multipart(request):
        metadata, image = await uploads.parts(request, "metadata", "image")
        return (await asyncio.to_thread(_from_files, server, metadata, image)).to_json()
    return (await asyncio.to_thread(_from_json, server, await request.body())).to_json()


def _from_files(server: Server, metadata: bytes, image: bytes) -> Map:
    try:
        text = metadata.decode()
    except UnicodeDecodeError as error:
        raise MapError(
            "the metadata is not text", path="metadata", got=str(error), expected="YAML in UTF-8"
        ) from None
    return server.maps.add(load_map(text, image), {})


def _from_json(server: Server, content: bytes) -> Map:
    body = uploads.parse(UPLOAD, content)
    if isinstance(body, HouseMap):
        return server.maps.add(*load_house(body.house, body.asset_sizes, body.resolution))
    return server.maps.add(from_occupancy_grid(body.info, body.data), {})


@router.get("", response_model=MapList, summary="List the maps", responses=problems())
async def list_all(server: ServerState, cursor: Cursor = None, limit: Limit = 100) -> Any:
    """In order of name and id."""
    found, following = await asyncio.to_thread(server.maps.page, cursor, limit)
    return {"items": found, "next": following}


@router.get(
    "/{map_id}", response_model=MapResponse, summary="Read a map", responses=problems(_404="No such map.")
)
async def read(map_id: MapId, server: ServerState) -> Any:
    """Its size, place and named areas."""
    return (await asyncio.to_thread(server.maps.get, map_id)).to_json()


@router.get(
    "/{map_id}/image.png",
    response_class=Response,
    summary="See a map",
    responses={
        200: {"content": {"image/png": {}}, "description": "One pixel a cell."},
        **problems(_404="No such map."),
    },
)
async def image(map_id: MapId, server: ServerState) -> Response:
    """White is free, black occupied; up is the map's y."""
    found = await asyncio.to_thread(server.maps.get, map_id)
    return Response(await asyncio.to_thread(found.png), media_type="image/png")
