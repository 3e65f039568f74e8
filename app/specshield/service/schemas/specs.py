"""Regions, maps and rules. world/formats.py has the forms in which maps are sent."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from specshield.service import examples
from specshield.service.schemas.base import Id, Point, Strict
from specshield.task import MAX_REGIONS
from specshield.world.regions import MAX_MEMBERS, MAX_VERTICES


class Circle(Strict):
    type: Literal["circle"]
    center: Point
    radius: float = Field(gt=0, le=1e8, description="In metres.")


class Rectangle(Strict):
    """A rectangle whose sides are parallel to the axes of the map frame."""

    type: Literal["rectangle"]
    min: Point
    max: Point


class Polygon(Strict):
    """A simple polygon: its edges touch only at their ends. The last vertex is joined to the first."""

    type: Literal["polygon"]
    vertices: list[Point] = Field(
        min_length=3, max_length=MAX_VERTICES, fail_fast=True, description="In order, each [x, y] in metres."
    )


Shape = Annotated[Circle | Rectangle | Polygon, Field(discriminator="type")]


class Union(Strict):
    """All points that are inside some member."""

    type: Literal["union"]
    members: list[Shape] = Field(
        min_length=1, max_length=MAX_MEMBERS, fail_fast=True, description="Regions that are no unions."
    )


Region = Annotated[Circle | Rectangle | Polygon | Union, Field(discriminator="type")]
Regions = Annotated[
    dict[str, Region],
    Field(
        max_length=MAX_REGIONS,
        fail_fast=True,
        description="Regions by name. In a formula the name is the signed distance [m], positive inside.",
    ),
]
Signals = Annotated[
    dict[str, float],
    Field(
        max_length=64,
        fail_fast=True,
        description="Other signals by name, each with its value before its first sample.",
    ),
]
Formula = Annotated[
    str,
    Field(
        min_length=1,
        max_length=10_000,
        json_schema_extra={"format": "stl"},  # the grammar is more than a pattern can say
        description="Signal temporal logic: `F[0,60] (Charger1 or Charger2) and G[0,150] not Forbidden`. "
        "A region's name holds when the robot's origin is in the region, `touches(R)` when any part of the "
        "footprint is, `inside(R)` when all of it is.",
    ),
]


class MapResponse(BaseModel):
    id: str = Field(description="A hash of the map's content.")
    name: str | None = Field(description="The map's name, accepted wherever its id is; null: it has none.")
    resolution: float = Field(description="Side of a cell [m].")
    width: int = Field(description="Cells along x.")
    height: int = Field(description="Cells along y.")
    origin: list[float] = Field(description="[x, y, yaw] of the lower-left corner [m, m, rad].")
    bounds: list[float] = Field(description="[xmin, ymin, xmax, ymax] in metres, map frame.")
    rooms: dict[str, Region] = Field(description="Named areas; their names can be used in formulas.")


class MapList(BaseModel):
    items: list[MapResponse]
    next: str | None = Field(description="The `cursor` of the next page; null on the last page.")


class SpecRequest(Strict):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.SPEC_REQUEST]})

    formula: Formula
    regions: Regions | None = Field(None, description="Regions by name.")
    signals: Signals | None = Field(None, description="The initial values of other signals, by name.")
    map_id: Id | None = Field(None, description="Id or name of a map, whose rooms are names too.")


class Window(BaseModel):
    operator: Literal["G", "F", "U"] = Field(description="Always, eventually or until.")
    formula: str = Field(description="The operator with its operands.")
    begin: int = Field(description="The first step that the operator may look at.")
    end: int = Field(description="The last step that the operator may look at.")
    depth: int = Field(description="The number of other windows in which this one lies.")


class SpecResponse(BaseModel):
    formula: str = Field(description="The canonical text, which parses to an equal formula.")
    horizon: int = Field(description="The horizon T in steps: T + 1 states decide the formula.")
    names: list[str] = Field(description="The names in the formula, sorted.")
    windows: list[Window] = Field(description="The steps of each temporal operator, outermost first.")
    avoided: list[str] = Field(description="The names that the formula asks not to hold.")
    methods: list[str] = Field(
        description="The methods that take such a rule, of those that come with the server. Making a policy "
        "shows whether a method can serve the rule on a map."
    )


class Spec(Strict):
    formula: Formula
    regions: Regions = Field(default_factory=dict)
    signals: Signals = Field(default_factory=dict)
