"""Steps: the request and the answer of a decision, of closing a session, and the trajectory."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from pydantic import BaseModel, ConfigDict, Field, model_validator

from specshield.service import examples
from specshield.service.schemas.base import Point, Pose, Poses, SpecStatus, Strict
from specshield.service.schemas.sessions import SessionResponse, SessionRule

MOST_POINTS = 2000  # of each kind, in one step
Points = Annotated[list[Point], Field(max_length=MOST_POINTS, fail_fast=True)]


class StepRequest(Strict):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.STEP]})

    t: int = Field(
        ge=0,
        le=1_000_000,
        description="The step to decide. A step is decided once: sent again, it returns the stored answer.",
    )
    poses: Poses = Field(
        description="The poses up to x_t, where the robot is now. The first one may be any pose that the "
        "server has already, or the first that it does not have."
    )
    logits: list[float | None] | None = Field(
        None,
        max_length=256,
        description="One logit for each action; null is minus infinity. Not needed after the main task.",
    )
    main_task_done: bool = Field(
        False, description="Whether the main task is over; then true at every further step."
    )
    signals: dict[str, float] | None = Field(
        None,
        max_length=64,
        fail_fast=True,
        description="Samples at t of the spec's signals; a signal that is left out keeps its last value.",
    )
    witnesses: bool = Field(False, description="Whether to answer a certified continuation for every action.")
    occupied: Points | None = Field(
        None,
        description="Points at which the robot's sensors see an obstacle now, map frame. They count at once. "
        "`[]`: the sensors see none.",
    )
    free: Points | None = Field(
        None, description="Points at which the robot's sensors see free floor now, map frame."
    )
    explain: bool = Field(False, description="Whether to say of each forbidden action what it would break.")


LARGEST = 1.7976931348623157e308  # larger numbers and NaN are refused
Finite = Annotated[float, msgspec.Meta(ge=-LARGEST, le=LARGEST)]
SentCoordinate = Annotated[float, msgspec.Meta(ge=-1e8, le=1e8)]
SentPose = Annotated[list[SentCoordinate], msgspec.Meta(min_length=3, max_length=3)]
SentPoint = Annotated[list[SentCoordinate], msgspec.Meta(min_length=2, max_length=2)]
SentPoints = Annotated[list[SentPoint], msgspec.Meta(max_length=MOST_POINTS)]


class StepBody(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A `StepRequest` in the form that is fast to read; `StepRequest` says why one is refused."""

    t: Annotated[int, msgspec.Meta(ge=0, le=1_000_000)]
    poses: Annotated[list[SentPose], msgspec.Meta(min_length=1, max_length=10_001)]
    logits: Annotated[list[Finite | None], msgspec.Meta(max_length=256)] | None = None
    main_task_done: bool = False
    signals: Annotated[dict[str, Finite], msgspec.Meta(max_length=64)] | None = None
    witnesses: bool = False
    occupied: SentPoints | None = None
    free: SentPoints | None = None
    explain: bool = False


class Residual(BaseModel):
    translation: float = Field(description="In metres.")
    rotation: float = Field(description="In radians.")


class Explanation(BaseModel):
    conjunct: str = Field(description="The part of the formula that the action's best future does not keep.")
    robustness: float | None = Field(description="The part's robustness on that future; null: it has none.")
    late_by: int | None = Field(
        description="By how many steps that future comes too late; null if time is not the reason."
    )
    detail: str | None = Field(
        None,
        description="More in words: which half of an `until` fails and when, when the place of a `G` is "
        "reached or left, or that a way is known which the policies did not find. Absent if that is all.",
    )


class StepResponse(BaseModel):
    t: int = Field(description="The step that was decided.")
    mode: Literal["prior", "shaped", "completion", "fallback", "violated"] = Field(
        description="How `distribution` came about. `prior`: it is the model's own, as the rule is settled. "
        "`shaped`: it is the closest to the model's that keeps the rule. `completion`: the main task is "
        "over, and the certified continuation goes on. `fallback`: no action to which the model gives "
        "probability keeps the rule; `reason` says more. `violated`: the rule is broken, and what is left "
        "of it is kept."
    )
    distribution: list[float] = Field(description="pi*: the probability of each action.")
    j_values: list[float | None] = Field(description="J of each action; null if it was not evaluated.")
    robustness: list[float | None] = Field(
        description="For each action, rho of the joint trajectory that certifies it, or of the best one."
    )
    action: int = Field(description="The action drawn from `distribution` by the session's seed and t.")
    action_name: str = Field(description="The name of `action`.")
    completion_action: int | None = Field(
        description="The action to run if `action` ends the task: the next one of the certified "
        "continuation, or in mode `fallback` what the policy would do. Null in mode `prior`."
    )
    spec_status: SpecStatus = Field(description="The verdict on x_0 .. x_t, whatever may follow.")
    feasible_mass: float | None = Field(
        description="pi_FM(S_t): the probability that the model itself gives to S_t, if it does not end."
    )
    kl: float | None = Field(
        description="KL(pi* || pi_FM) [nats]; null without logits, and if the model excludes an action that "
        "pi* does not."
    )
    reason: str | None = Field(
        description="Why the mode is `fallback` (`infeasible`, `zero_prior_mass`); or `margin_unattainable`: "
        "the margin or the slack that was asked for could not be had."
    )
    finished: bool = Field(description="Whether no further step will be decided.")
    in_collision: bool = Field(description="Whether x_t touches an obstacle.")
    next_poses: list[Pose] = Field(description="f(x_t, a) for each action.")
    residual: Residual | None = Field(
        description="How far x_t is from the nearest pose that the last decision foresaw."
    )
    warnings: list[str] = Field(
        description="What did not go as it should, such as a policy whose proposal could not be used."
    )
    witness: list[int] | None = Field(
        description="The certified continuation: the actions that follow the one to run, up to the rule's "
        "last step. Null: none is certified."
    )
    witnesses: list[list[int] | None] | None = Field(
        None, description="The certified continuation after each action, if asked for."
    )
    margin: float = Field(description="The robustness above 0 that J asked for at this step [m].")
    slack: int = Field(description="The reserve before deadlines that J asked for at this step [steps].")
    threshold_left: float = Field(
        description="The threshold of the next step. With `threshold_over` `episode` it changes, and is a "
        "share of the best chance that the next step has."
    )
    map_revision: int = Field(
        description="How often the session's own map has changed; 0: it equals the policy's map."
    )
    any_signal: bool | None = Field(
        None,
        description="Whether each action that J allows has a future that keeps the rule whatever the signals "
        "do from now on. False: only if they stay as they are. Left out if the rule reads no signals, and "
        "with `uncertainty` `none`, which takes them to stay as they are.",
    )
    explanations: list[Explanation | None] | None = Field(
        None, description="Why each action is forbidden, if asked for; null for an allowed action."
    )


class CloseRequest(Strict):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.CLOSE]})

    t: int | None = Field(
        None, ge=0, le=1_000_000, description="The last step reached. Default: the last one stored."
    )
    poses: Poses | None = Field(None, description="Poses that end with x_t, as in a step.")

    @model_validator(mode="after")
    def _both_or_neither(self) -> CloseRequest:
        if (self.t is None) != (self.poses is None):
            raise ValueError("t and poses, both or neither")
        return self


class CloseResponse(SessionResponse):
    robustness_bounds: list[float | None] = Field(
        description="[lo, hi] of the robustness over all continuations; equal at the horizon; null: no bound."
    )


class Learned(BaseModel):
    t: int = Field(description="The step before `next_t`, up to which this was learned; -1: no step yet.")
    map_id: str = Field(description="Id of the map that has these cells.")
    map_revision: int = Field(description="How often the session's own map has changed; 0: not at all.")
    occupied: list[int] = Field(description="Cells that are free on the map and were found occupied.")
    free: list[int] = Field(description="Cells that are occupied on the map and were found free.")


class TrajectoryItem(BaseModel):
    t: int = Field(description="The step.")
    pose: Pose
    signals: dict[str, float] = Field(description="The values of the signals at t.")
    rule: int = Field(description="The index in `rules` of the rule that decides, or decided, this step.")
    logits: list[float | None] | None = Field(description="The logits of the step's request.")
    decision: StepResponse | None = Field(
        description="The answer that was given; null for a step without a decision."
    )


class Trajectory(BaseModel):
    items: list[TrajectoryItem]
    next: None = Field(None, description="Always null: a trajectory is one page.")
    rules: list[SessionRule] = Field(description="The session's `rules`.")
