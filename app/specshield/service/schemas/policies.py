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
    """The methods that are installed where the description is made."""
    told = [f"`{name}`: {method.about}" for name, method in METHODS.usable()]
    schema |= {"enum": METHODS.names(), "description": "How the policy is made. " + " ".join(told)}


def _describe_options(schema: dict[str, Any]) -> None:
    """Those of each method that is installed."""
    del schema["additionalProperties"]
    schema["anyOf"] = [{"title": name, **options_schema(made.options)} for name, made in METHODS.usable()]
    schema["description"] = "The method's options; those left out are at their defaults."


class PolicyRequest(Strict):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.POLICY]})

    map_id: Id = Field(description="Id or name of the map.")
    robot: RobotChoice = Field("stretch", description="A preset (`stretch`) or a robot of your own.")
    spec: Spec
    method: Name = Field(DEFAULT, json_schema_extra=_describe_methods)
    seed: int = Field(0, ge=0, lt=2**63, description="Of everything random in the training.")
    options: Options = Field(default_factory=dict, json_schema_extra=_describe_options)
    name: Id | None = Field(None, description="A name of your own for it, accepted wherever its id is.")


class Card(BaseModel):
    """What has to be in a policy's card.json; whatever else it tells is kept."""

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
    id: str = Field(description="Hash of map, task, method, options and seed.")
    name: str | None = Field(description="Its name, if it has one; accepted wherever an id is.")
    status: Literal["queued", "training", "ready", "failed"] = Field(description="Sessions need `ready`.")
    progress: float = Field(description="0 to 1.")
    eta_s: float | None = Field(description="Estimate of the time left [s]; null where there is none.")
    error: str | None = Field(description="Why it failed, or is not begun.")
    metrics: dict[str, JsonValue] = Field(description="What was measured, such as the rate of satisfaction.")
    warnings: list[str] = Field(
        description="What there is to know of a policy that is ready, such as a rule that no start can keep."
    )
    map_id: str = Field(description="Id of the map.")
    robot: str | dict[str, JsonValue] = Field(description="A preset's name, or the robot as it was sent.")
    spec: dict[str, JsonValue] = Field(
        description="`formula`, `signals` and, where one policy is read, `regions`."
    )
    horizon: int = Field(description="The horizon T in steps.")
    method: str = Field(description="How it is made.")
    seed: int = Field(description="As asked for.")
    options: dict[str, JsonValue] = Field(description="Every setting of the method.")
    created_at: str | None = Field(description="RFC 3339; null for one that came with the server.")


class PolicyList(BaseModel):
    items: list[PolicyResponse]
    next: str | None = Field(description="`cursor` of the next page; null on the last.")
