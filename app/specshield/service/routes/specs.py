"""/v1/specs: formulas before they are used."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter

from specshield.errors import FormulaError
from specshield.service.schemas.specs import SpecRequest, SpecResponse
from specshield.service.state import ServerState, problems
from specshield.stl import parse
from specshield.task import names_for, parse_regions, parse_signals

router = APIRouter(prefix="/v1/specs", tags=["specifications"])


@router.post("/validate", summary="Check a formula", responses=problems(_404="No such map."))
async def validate(request: SpecRequest, server: ServerState) -> SpecResponse:
    """Parse a formula and give its canonical text, its horizon and its names.

    A formula that does not parse is answered with the `position` of the error in the text. Names are checked
    where `regions`, `signals` or `map_id` say which there are; `x`, `y` [m] and `theta` [rad] always are.
    """
    return await asyncio.to_thread(_validate, request, server)


def _validate(request: SpecRequest, server: ServerState) -> SpecResponse:
    body = request.model_dump()
    regions = parse_regions(body["regions"] or {})
    signals = parse_signals(body["signals"] or {}, regions)
    rooms = server.maps.get(request.map_id).rooms if request.map_id else {}
    declared = any(given is not None for given in (request.regions, request.signals, request.map_id))
    names = names_for({**rooms, **regions}, signals) if declared else None
    try:
        formula = parse(request.formula, names=names, max_horizon=server.settings.max_horizon)
    except FormulaError as error:
        raise error.at("formula") from None
    return SpecResponse(formula=str(formula), horizon=formula.horizon, names=list(formula.names))
