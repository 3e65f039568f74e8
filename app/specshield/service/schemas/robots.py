"""Robots, in the form in which requests for policies have them, and in the form in which they are shown."""

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
    name: Name = Field(description="A name that no other action has.")
    translate: float = Field(0.0, description="How far the robot moves along its heading [m].")
    rotate: float = Field(0.0, description="How far it then turns counter-clockwise [rad].")
    terminal: bool = Field(False, description="Whether it ends the main task, moving nothing, in no step.")


class RobotSpec(Strict):
    footprint: Footprint
    on_contact: Literal["stay", "stop"] = Field(
        "stay", description="Whether a move that would touch something is not made, or stops there."
    )
    actions: list[ActionSpec] = Field(min_length=1, max_length=256, fail_fast=True)


class RobotResponse(BaseModel):
    name: str = Field(description="A preset's name; `custom` for a robot that came with a policy.")
    footprint: Footprint
    on_contact: Literal["stay", "stop"] = Field(
        description="Whether a move that would touch something is not made, or stops there."
    )
    actions: list[ActionSpec] = Field(description="The actions in the order of the logits.")


class RobotList(BaseModel):
    items: list[RobotResponse]
    next: None = Field(None, description="Always null: the presets are one page.")


def describe(robot: Robot) -> dict[str, Any]:
    """The robot in the form of `RobotResponse`."""
    return {
        "name": robot.name,
        "footprint": {"radius": robot.radius, "offset": list(robot.offset)},
        "on_contact": robot.on_contact,
        "actions": [asdict(action) for action in robot.actions],
    }
