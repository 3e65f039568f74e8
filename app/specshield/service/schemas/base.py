"""What all schemas share. Metres, radians counter-clockwise, map frame (REP-103)."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

SpecStatus = Literal["pending", "satisfied", "violated"]
ID = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}"
ID_TOLD = "1 to 64 letters from A to Z or a to z, digits, '_', '.' or '-', the first a letter or digit"
Id = Annotated[str, Field(pattern=f"^{ID}$")]
Coordinate = Annotated[float, Field(ge=-1e8, le=1e8)]
Pose = Annotated[
    list[Coordinate],
    Field(min_length=3, max_length=3, fail_fast=True, description="[x, y, theta] [m, m, rad], map frame."),
]
Poses = Annotated[list[Pose], Field(min_length=1, max_length=10_001, fail_fast=True)]
Point = Annotated[
    list[Coordinate],
    Field(min_length=2, max_length=2, fail_fast=True, description="[x, y] in metres, map frame."),
]
MOST_UNKNOWN = 20  # unknown fields that get an error each
# What is valid, by the type of the error.
TOLD = {"extra_forbidden": "one of {known}", "too_many_fields": "no other fields than {known}"}
Name = Annotated[str, Field(min_length=1, max_length=64)]


class Strict(BaseModel):
    """Requests: no unknown fields, no conversions, no NaN or infinity.

    Their lists and dictionaries are `fail_fast`: the errors of thousands of members would take long to make.
    """

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="wrap")
    @classmethod
    def _tell_known_fields(cls, value: Any, validate: ModelWrapValidatorHandler[Self]) -> Self:
        known = {"known": ", ".join(cls.model_fields)}
        if isinstance(value, dict) and len(value) > len(cls.model_fields) + MOST_UNKNOWN:
            raise PydanticCustomError("too_many_fields", TOLD["too_many_fields"], known)
        try:
            return validate(value)
        except ValidationError as invalid:
            found = [_with_known(item, known) for item in invalid.errors(include_url=False)]
            raise ValidationError.from_exception_data(cls.__name__, found) from None


def _with_known(item: ErrorDetails, known: dict[str, Any]) -> InitErrorDetails:
    """The same error again. An unknown field's says which are known; one of a member's says so already."""
    kind: Any = item["type"]
    context = item.get("ctx", {})
    if kind in TOLD:
        kind = PydanticCustomError(kind, TOLD[kind], context or known)
    return InitErrorDetails(type=kind, loc=item["loc"], input=item["input"], ctx=context)


class Health(BaseModel):
    status: Literal["ok"]
