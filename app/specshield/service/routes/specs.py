"""/v1/specs: checks formulas before they are used."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request

from specshield.service import examples
from specshield.service.heavy.uploads import explain
from specshield.service.schemas.specs import SpecResponse
from specshield.service.state import TOO_MUCH, Owner, ServerState, json_body, problems

router = APIRouter(prefix="/v1/specs", tags=["specifications"])
SHORT = 2 << 10  # [bytes]; a formula of this size is read within some 5 ms, one of 16 kB takes 50


@router.post(
    "/validate",
    response_model=SpecResponse,
    summary="Check a formula",
    responses=problems(_404="No such map.", **TOO_MUCH),
    openapi_extra={
        "requestBody": {"required": True, "content": json_body("SpecRequest", examples.SPEC_REQUEST)}
    },
)
async def validate(request: Request, server: ServerState, owner: Owner) -> Any:
    """Parse a formula and give its canonical text, its horizon and its names.

    For a formula that does not parse, the problem has the `position` of the error in the text. Names are
    checked where `regions`, `signals` or `map_id` are given; `x`, `y` [m] and `theta` [rad] are always known.
    """
    content = await request.body()
    if len(content) > SHORT:
        return await server.heavy.run(request, "check_spec", content, owner)
    return await asyncio.to_thread(explain, server.maps, server.settings, content, owner)
