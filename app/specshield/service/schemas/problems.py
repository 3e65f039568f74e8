"""Problem documents (RFC 9457)."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from specshield.service.schemas.specs import Region


class FieldError(BaseModel):
    path: str = Field(description="The field, such as `poses[0][2]`.")
    got: JsonValue = Field(None, description="What the field held, shortened.")
    expected: str = Field(description="What is valid.")


class ProblemConjunct(BaseModel):
    formula: str = Field(description="This part of the rule.")
    feasible_alone: bool = Field(description="Whether a future was found that keeps this part by itself.")
    robustness: float | None = Field(
        description="The part's highest robustness that was found while the other parts are kept, or alone "
        "if they cannot be kept [m]."
    )
    late_by: int | None = Field(
        description="By how many steps the part's window would have to end later (for `G[a,b] place`: begin "
        "later), so that the whole rule can be kept, or this part alone if it is not feasible alone. Null if "
        "no such number was found, or the rule would then be longer than it may be."
    )
    smaller_by: float | None = Field(
        None,
        description="By how much the regions that the part keeps out of (`G[a,b] not R`) would have to be "
        "smaller all round, for the same [m]. Null if no such number was found.",
    )
    regions: dict[str, Region] | None = Field(
        None, description="These regions, each made smaller by that, or by as much as it can be."
    )


class Problem(BaseModel):
    """An error in the form of RFC 9457. It may have more members, such as `position` or `expected_t`."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(description="A stable word for programs, such as `history-gap`.")
    title: str = Field(description="The same word for people.")
    status: int = Field(description="The HTTP status.")
    detail: str = Field(description="What was wrong, for people.")
    path: str | None = Field(None, description="The field that is wrong.")
    got: JsonValue = Field(None, description="What the field held, shortened.")
    expected: str | None = Field(None, description="What is valid there.")
    errors: list[FieldError] | None = Field(
        None, description="Every field that is wrong, where the schema refuses the request."
    )
    retry_after: int | None = Field(None, description="Of `rate-limited`: the header Retry-After [s].")
    proved: bool | None = Field(
        None, description="Of an infeasible rule: true if no future exists, false if none was found."
    )
    conjuncts: list[ProblemConjunct] | None = Field(
        None, description="Of an infeasible rule: what is wrong with each part that `and` joins."
    )
