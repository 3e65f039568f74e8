"""Policies."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, JsonValue, Tag

from specshield.policy.methods import DEFAULT, METHODS
from specshield.policy.options import options_schema
from specshield.service import examples
from specshield.service.schemas.base import Id, Name, Strict
from specshield.service.schemas.robots import RobotSpec
from specshield.service.schemas.specs import Spec

RobotChoice = Annotated[
    Annotated[Name, Tag("name")] | Annotated[RobotSpec, Tag("robot")],
    Discriminator(lambda value: "name" if isinstance(value, str) else "robot"),
]
Options = Annotated[dict[str, bool | int | float | str | list[float]], Field(max_length=64, fail_fast=True)]


def _describe_methods(schema: dict[str, Any]) -> None:
    """Describes the methods that are installed on the server."""
    told = [f"`{name}`: {method.about}" for name, method in METHODS.usable()]
    schema |= {"enum": METHODS.names(), "description": "How the policy is made. " + " ".join(told)}


def _describe_options(schema: dict[str, Any]) -> None:
    """Describes the options of each installed method."""
    del schema["additionalProperties"]
    schema["anyOf"] = [{"title": name, **options_schema(made.options)} for name, made in METHODS.usable()]
    schema["description"] = "The method's options; options that are left out have their defaults."


class PolicyRequest(Strict):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.POLICY]})

    map_id: Id = Field(description="Id or name of the map.")
    robot: RobotChoice = Field("stretch", description="A preset (`stretch`) or a robot of your own.")
    spec: Spec
    method: Name = Field(DEFAULT, json_schema_extra=_describe_methods)
    seed: int = Field(0, ge=0, lt=2**63, description="The seed of everything random in making the policy.")
    options: Options = Field(default_factory=dict, json_schema_extra=_describe_options)
    name: Id | None = Field(None, description="Your own name for the policy, accepted wherever its id is.")


class Card(BaseModel):
    """The members that a policy's card.json needs; other members are kept too."""

    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)

    map_id: Id
    robot: RobotChoice
    spec: Spec
    method: Name
    seed: int = Field(ge=0, lt=2**63)
    options: Options
    task_hash: Name
    metrics: dict[str, JsonValue] = Field(max_length=256, fail_fast=True)


class PolicyResponse(BaseModel):
    id: str = Field(
        description="A hash of map, task, method, options and seed, and of the files if the policy was sent."
    )
    name: str | None = Field(description="The policy's name, accepted wherever its id is; null: it has none.")
    status: Literal["queued", "training", "ready", "failed"] = Field(description="Sessions need `ready`.")
    progress: float = Field(description="From 0 to 1.")
    eta_s: float | None = Field(description="Estimate of the time left [s]; null if there is none.")
    error: str | None = Field(description="Why the policy failed, or why its making has not begun.")
    metrics: dict[str, JsonValue] = Field(description="What was measured, such as the rate of satisfaction.")
    warnings: list[str] = Field(
        description="Warnings about a policy that is ready, such as a rule that no start can keep."
    )
    map_id: str = Field(description="Id of the map.")
    robot: str | dict[str, JsonValue] = Field(description="A preset's name, or the robot as it was sent.")
    spec: dict[str, JsonValue] = Field(description="`formula`, `signals` and, but not in lists, `regions`.")
    horizon: int = Field(description="The horizon T in steps.")
    method: str = Field(description="How the policy is made.")
    seed: int = Field(description="The seed of the request.")
    options: dict[str, JsonValue] = Field(description="All options of the method.")
    created_at: str | None = Field(description="RFC 3339; null for a policy that came with the server.")


class PolicyList(BaseModel):
    items: list[PolicyResponse]
    next: str | None = Field(description="The `cursor` of the next page; null on the last page.")
