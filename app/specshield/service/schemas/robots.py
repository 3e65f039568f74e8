"""Robots: as they are sent with a policy, and as they are shown."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Literal

from pydantic import BaseModel, Field

from specshield.robot import Robot
from specshield.service.schemas.base import Name, Strict


class Footprint(Strict):
    """A disc."""

    radius: float = Field(gt=0, le=5, description="In metres.")
    offset: list[float] = Field(
        default_factory=lambda: [0.0, 0.0],
        min_length=2,
        max_length=2,
        description="Of its centre in the robot's frame: [ahead, to the left] in metres.",
    )


class ActionSpec(Strict):
    name: Name = Field(description="Unlike the others'.")
    translate: float = Field(0.0, description="Along the heading [m].")
    rotate: float = Field(0.0, description="Counter-clockwise, after the translation [rad].")
    terminal: bool = Field(False, description="Ends the main task: moves nothing, consumes no step.")


class RobotSpec(Strict):
    footprint: Footprint
    on_contact: Literal["stay", "stop"] = Field(
        "stay", description="What a move that would touch something does."
    )
    actions: list[ActionSpec] = Field(min_length=1, max_length=256, fail_fast=True)


class RobotResponse(BaseModel):
    name: str = Field(description="A preset's name; `custom` for a robot that came with a policy.")
    footprint: Footprint
    on_contact: Literal["stay", "stop"] = Field(description="What a move that would touch something does.")
    actions: list[ActionSpec] = Field(description="In the order of the logits.")


class RobotList(BaseModel):
    items: list[RobotResponse]
    next: None = Field(None, description="Always null: the presets are one page.")


def describe(robot: Robot) -> dict[str, Any]:
    """As `RobotResponse` has it: a preset is told in full."""
    return {
        "name": robot.name,
        "footprint": {"radius": robot.radius, "offset": list(robot.offset)},
        "on_contact": robot.on_contact,
        "actions": [asdict(action) for action in robot.actions],
    }
