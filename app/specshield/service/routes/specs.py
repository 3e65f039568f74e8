"""/v1/specs: formulas before they are used."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request

from specshield.service import examples
from specshield.service.access.owners import Owner
from specshield.service.heavy.uploads import explain
from specshield.service.schemas.specs import SpecResponse
from specshield.service.state import TOO_MUCH, ServerState, json_content, problems

router = APIRouter(prefix="/v1/specs", tags=["specifications"])
SHORT = 16 << 10  # [bytes] of a body that is read in a few ms


@router.post(
    "/validate",
    response_model=SpecResponse,
    summary="Check a formula",
    responses=problems(_404="No such map.", **TOO_MUCH),
    openapi_extra={
        "requestBody": {"required": True, "content": json_content("SpecRequest", examples.SPEC_REQUEST)}
    },
)
async def validate(request: Request, server: ServerState, owner: Owner) -> Any:
    """Parse a formula and give its canonical text, its horizon and its names.

    A formula that does not parse is answered with the `position` of the error in the text. Names are checked
    where `regions`, `signals` or `map_id` say which there are; `x`, `y` [m] and `theta` [rad] always are.
    """
    content = await request.body()
    if len(content) > SHORT:
        return await server.heavy.run(request, "check_spec", content, owner)
    return await asyncio.to_thread(explain, server.maps, server.settings, content, owner)
