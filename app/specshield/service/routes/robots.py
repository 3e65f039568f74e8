"""/v1/robots: the footprint and the actions of each robot that came with the server."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path

from specshield.errors import NotFound
from specshield.robot import PRESETS
from specshield.service.schemas.robots import RobotList, RobotResponse, describe
from specshield.service.state import problems

router = APIRouter(prefix="/v1/robots", tags=["robots"])
RobotName = Annotated[
    str, Path(max_length=64, description="A preset.", openapi_examples={"stretch": {"value": "stretch"}})
]


@router.get("", response_model=RobotList, summary="List the robots", responses=problems())
async def list_all() -> Any:
    """The presets. To use a robot of your own, send it in the same form when you ask for a policy."""
    return {"items": [describe(robot) for robot in PRESETS.values()], "next": None}


@router.get(
    "/{name}", response_model=RobotResponse, summary="Read a robot", responses=problems(_404="No such robot.")
)
async def read(name: RobotName) -> Any:
    """The robot's footprint and actions: metres along the heading, then radians counter-clockwise."""
    if name not in PRESETS:
        expected = f"one of {', '.join(sorted(PRESETS))}"
        raise NotFound(f"there is no robot {name!r}", path="name", got=name, expected=expected)
    return describe(PRESETS[name])
