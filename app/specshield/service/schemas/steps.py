"""Steps: what a decision is asked with, what it answers, and what ends a session."""

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
        description="The step to decide. It is the lock: sent again, it returns the stored answer.",
    )
    poses: Poses = Field(
        description="Ends with x_t; the whole history or any newest part that joins what the server has."
    )
    logits: list[float | None] | None = Field(
        None,
        max_length=256,
        description="Logits, one an action; null is minus infinity. Not needed after the main task.",
    )
    main_task_done: bool = Field(False, description="The main task is over: true at every step from then on.")
    signals: dict[str, float] | None = Field(
        None,
        max_length=64,
        fail_fast=True,
        description="Samples at t of the signals that the spec declares; one left out holds its last value.",
    )
    witnesses: bool = Field(False, description="Answer a certified continuation for every action.")
    occupied: Points | None = Field(
        None,
        description="Points at which the robot's sensors see an obstacle now, map frame. They count at once. "
        "`[]`: they see none.",
    )
    free: Points | None = Field(
        None, description="Points at which the robot's sensors see free floor now, map frame."
    )
    explain: bool = Field(False, description="Say of each forbidden action what it would break.")


LARGEST = 1.7976931348623157e308  # what is beyond, or not a number, is refused
Finite = Annotated[float, msgspec.Meta(ge=-LARGEST, le=LARGEST)]
SentCoordinate = Annotated[float, msgspec.Meta(ge=-1e8, le=1e8)]
SentPose = Annotated[list[SentCoordinate], msgspec.Meta(min_length=3, max_length=3)]
SentPoint = Annotated[list[SentCoordinate], msgspec.Meta(min_length=2, max_length=2)]
SentPoints = Annotated[list[SentPoint], msgspec.Meta(max_length=MOST_POINTS)]


class StepBody(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A `StepRequest` as it is read: a fifth of the time. What this does not take, `StepRequest` says why."""

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
    robustness: float | None = Field(description="Of that part on it; null: it has none.")
    late_by: int | None = Field(
        description="By how many steps that future comes too late; null where time is not what is missing."
    )
    detail: str | None = Field(
        None,
        description="In words: which half of an `until` fails and when, when the place of a `G` is reached "
        "or left, or that a way is known which the policies did not find. Absent where the rest says it all.",
    )


class StepResponse(BaseModel):
    t: int = Field(description="The step that was decided.")
    mode: Literal["prior", "shaped", "completion", "fallback", "violated"] = Field(
        description="How `distribution` came about. `prior`: it is the model's own; the rule is settled. "
        "`shaped`: it is the closest to the model's that keeps the rule. `completion`: the main task is "
        "over, and the certified continuation goes on. `fallback`: nothing that the model gives any "
        "probability keeps the rule; `reason` says more. `violated`: the rule is broken, and what is left "
        "of it is kept."
    )
    distribution: list[float] = Field(description="pi*: the probability of each action.")
    j_values: list[float | None] = Field(description="J of each action; null where it was not evaluated.")
    robustness: list[float | None] = Field(
        description="rho of the joint trajectory that certifies (or fails) each action."
    )
    action: int = Field(description="Drawn from `distribution` by the session's seed and t.")
    action_name: str = Field(description="Its name.")
    completion_action: int | None = Field(
        description="The certified continuation; null once the specification is settled."
    )
    spec_status: SpecStatus = Field(description="Of x_0 .. x_t, whatever may follow.")
    feasible_mass: float | None = Field(description="pi_FM(S_t), of the non-terminal actions.")
    kl: float | None = Field(
        description="KL(pi* || pi_FM) in nats; null where pi* leaves the prior's support."
    )
    reason: str | None = Field(description="Why the mode is a fallback, or what else there is to know.")
    finished: bool = Field(description="No further step will be taken.")
    in_collision: bool = Field(description="x_t touches an obstacle: the world is what it is.")
    next_poses: list[Pose] = Field(description="f(x_t, a) for each action.")
    residual: Residual | None = Field(
        description="How far x_t is from the nearest pose that the last decision foresaw."
    )
    warnings: list[str] = Field(
        description="What did not go as it should, such as a policy whose proposal could not be used."
    )
    witness: list[int] | None = Field(description="Action indices that follow `action` to the horizon.")
    witnesses: list[list[int] | None] | None = Field(
        None, description="The same for each action, if asked for."
    )
    margin: float = Field(description="The robustness above 0 that J asked for at this step [m].")
    slack: int = Field(description="The steps in hand that J asked for at this step.")
    threshold_left: float = Field(
        description="The threshold of the next step; it changes where `threshold_over` is `episode`."
    )
    map_revision: int = Field(
        description="How often the session's own map has changed; 0: it is the policy's."
    )
    any_signal: bool | None = Field(
        None,
        description="Whether each action that J allows has a future that keeps the rule whatever the signals "
        "do from here on. False: only if they stay as they are. Left out where the rule reads no signals, "
        "and with `uncertainty` `none`, which takes them to stay as they are.",
    )
    explanations: list[Explanation | None] | None = Field(
        None, description="Why each action is forbidden, if asked for; null for one that is allowed."
    )


class CloseRequest(Strict):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.CLOSE]})

    t: int | None = Field(
        None, ge=0, le=1_000_000, description="The last step reached. Default: the last one stored."
    )
    poses: Poses | None = Field(None, description="Ends with x_t, joined as in a step.")

    @model_validator(mode="after")
    def _both_or_neither(self) -> CloseRequest:
        if (self.t is None) != (self.poses is None):
            raise ValueError("t and poses come together")
        return self


class CloseResponse(SessionResponse):
    robustness_bounds: list[float | None] = Field(
        description="[lo, hi] on the robustness over every continuation; equal at the horizon; null: none."
    )


class Learned(BaseModel):
    t: int = Field(description="The step before `next_t`, up to which this was learned; -1: none yet.")
    map_id: str = Field(description="Id of the map that the cells are of.")
    map_revision: int = Field(description="How often the session's own map has changed; 0: it is the map.")
    occupied: list[int] = Field(description="Cells that are free on the map, and were found occupied.")
    free: list[int] = Field(description="Cells that are occupied on the map, and were found free.")


class TrajectoryItem(BaseModel):
    t: int = Field(description="The step.")
    pose: Pose
    signals: dict[str, float] = Field(description="The samples held at t.")
    rule: int = Field(description="Which of `rules` decides, or decided, this step.")
    logits: list[float | None] | None = Field(description="Those that the step was asked with.")
    decision: StepResponse | None = Field(
        description="The answer given; null for a pose sent later or by close."
    )


class Trajectory(BaseModel):
    items: list[TrajectoryItem]
    next: None = Field(None, description="Always null: a trajectory is one page.")
    rules: list[SessionRule] = Field(description="As in the session.")
