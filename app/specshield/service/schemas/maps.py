"""Maps. Their requests are what each format says (world/formats.py)."""

from __future__ import annotations

from pydantic import Field

from specshield.service.schemas.base import Answer
from specshield.service.schemas.specs import Region


class MapResponse(Answer):
    id: str = Field(description="Hash of the content.")
    name: str | None = Field(description="Its name, if it has one; accepted wherever an id is.")
    resolution: float = Field(description="Side of a cell [m].")
    width: int = Field(description="Cells along x.")
    height: int = Field(description="Cells along y.")
    origin: list[float] = Field(description="[x, y, yaw] of the lower-left corner: [m, m, rad].")
    bounds: list[float] = Field(description="[xmin, ymin, xmax, ymax] in metres, map frame.")
    rooms: dict[str, Region] = Field(description="Named areas; their names can be used in formulas.")


class MapList(Answer):
    items: list[MapResponse]
    next: str | None = Field(description="`cursor` of the next page; null on the last.")
