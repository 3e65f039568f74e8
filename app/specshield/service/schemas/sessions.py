"""Sessions: the requests that begin and switch them, and their description."""

from __future__ import annotations

import math
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, JsonValue, model_validator

from specshield.lookahead.preferences import PREFERENCES, PROJECTION
from specshield.service import examples
from specshield.service.schemas.base import Id, Name, Pose, Poses, SpecStatus, Strict
from specshield.service.schemas.robots import RobotResponse
from specshield.shield.uncertainty import MOST_TRANSLATION


def _describe_shaping(schema: dict[str, Any]) -> None:
    """Describes the preferences that are installed on the server."""
    schema["enum"] = [PROJECTION, *PREFERENCES.names()]
    told = [f"`{name}`: {kind.about}" for name, kind in PREFERENCES.usable()]
    none = f"`{PROJECTION}`: the closest distribution that keeps the rule."
    schema["description"] = " ".join(["What is preferred among actions that keep the rule.", none, *told])


class KnownUncertainty(Strict):
    """What is known of the robot before its first step."""

    translation: float = Field(
        ge=0.0,
        le=MOST_TRANSLATION,
        description="Standard deviation of the position after a motion, along each axis [m].",
    )
    rotation: float = Field(ge=0.0, le=math.pi, description="Standard deviation of the heading [rad].")
    slip: float = Field(0.0, ge=0.0, le=1.0, description="Probability that a motion is not executed at all.")


Uncertain = Literal["learned", "none"] | KnownUncertainty


class _Policies(Strict):
    """The members that name one policy, or several policies for one task."""

    policy_id: Id | None = Field(None, description="Id or name of the policy.")
    policy_ids: list[Id] | None = Field(
        None,
        min_length=1,
        max_length=8,
        fail_fast=True,
        description="Several policies for one task: an action is feasible if any has a future for it.",
    )

    @model_validator(mode="after")
    def _one_way_to_name_policies(self) -> Self:
        if (self.policy_id is None) == (self.policy_ids is None):
            raise ValueError("exactly one of policy_id and policy_ids")
        return self

    @property
    def policies(self) -> list[str]:
        return self.policy_ids or [str(self.policy_id)]


class SessionRequest(_Policies):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.SESSION]})

    initial_pose: Pose = Field(description="x_0 [m, m, rad], map frame: inside the map and free.")
    id: Id | None = Field(None, description="Your own id for the session; by default the server makes one.")
    seed: int = Field(0, ge=0, lt=2**63, description="The seed from which, with t, each `action` is drawn.")
    threshold: float = Field(
        1.0,
        ge=0.0,
        description="delta, the least expected J of a step. With `feasibility` it is above 0 and at most 1; "
        "only 1 has the guarantee: 0.99^150 is 0.22. With `robustness` it is in metres, without guarantee.",
    )
    margin: float = Field(
        0.0, ge=0.0, le=1e8, description="Robustness to keep in reserve [the unit of the formula, m]."
    )
    slack: int = Field(
        0,
        ge=0,
        le=1000,
        description="Steps to keep in reserve: each F or U is satisfied so many steps before its window "
        "ends, and the place of each G is reached so many steps before its window begins, if possible.",
    )
    evaluation: Literal["feasibility", "robustness"] = Field(
        "feasibility",
        description="What J is: whether the rule can be kept, 1 or 0 (`feasibility`), or the robustness "
        "itself (`robustness`). With `robustness` only the mean of J reaches `threshold`, so actions that "
        "break the rule may keep some probability. If no action reaches the threshold, as often with 1 m, "
        "the answer is a `fallback`: choose a threshold that fits the rule.",
    )
    shaping: Name = Field(PROJECTION, json_schema_extra=_describe_shaping)
    max_steps: int | None = Field(
        None, ge=1, description="The step at which the session ends. Default: max(600, T + 1)."
    )
    allow_infeasible: bool = Field(False, description="Begin even if no action has a satisfying future.")
    uncertainty: Uncertain = Field(
        "learned",
        description="`learned`: margin and slack of every decision follow from how the robot has moved so "
        "far. At first they are large; they shrink while the robot moves as foreseen. A given `margin` or "
        "`slack` is the least that is kept. An object says what is known before the first step. `none`: the "
        "robot is taken to move exactly as described. The paper's settings have `learn_map` false too.",
    )
    learn_map: bool = Field(
        True, description="Whether a motion that stops short marks what it ran into on the session's map."
    )
    map_memory: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="After so many steps an `occupied` point is forgotten; null: not because of its age.",
    )
    threshold_over: Literal["step", "episode"] = Field(
        "step", description="Whether `threshold` holds at each step or over the whole episode."
    )


class SwitchRequest(_Policies):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.SWITCH]})

    t: int = Field(ge=0, le=1_000_000, description="The first step that the new rule decides.")
    clock: Literal["keep", "restart"] = Field(
        "keep",
        description="`keep`: the new rule's windows and history begin at the same step as those of the "
        "present rule, at first the session's start. `restart`: they begin at t.",
    )
    poses: Poses | None = Field(
        None,
        description="Poses that end with x_t, as in a step. By default x_t is taken to be where the last "
        "decision's action leads.",
    )


class SessionRule(BaseModel):
    begins: int = Field(alias="from", description="The first step that the rule decides, or decided.")
    origin: int = Field(description="The step from which the rule's windows count.")
    clock: Literal["keep", "restart"] = Field(description="The switch's `clock`; `restart` at first.")
    policy_ids: list[str] = Field(description="Ids of the rule's policies.")
    map_id: str = Field(description="Id of the rule's map.")
    formula: str = Field(description="The rule.")
    horizon: int = Field(description="The horizon T in steps from `origin`.")
    actions: list[str] = Field(description="Names of the robot's actions, in the order of the logits.")
    terminal_actions: list[int] = Field(description="Indices of the actions that end the main task.")
    spec_status: SpecStatus = Field(
        description="The verdict on the states from `origin` to the last one under this rule. `pending`: "
        "they neither kept nor broke it."
    )


class SessionResponse(BaseModel):
    id: str = Field(description="The session's id in the paths below /v1/sessions.")
    policy_ids: list[str] = Field(description="Ids of the session's policies.")
    map_id: str = Field(description="Id of the session's map.")
    spec: dict[str, JsonValue] = Field(description="`formula`, `signals` and, but not in lists, `regions`.")
    robot: RobotResponse | None = Field(None, description="The session's robot; not in lists.")
    horizon: int = Field(description="The horizon T in steps; the last shaped decision is at T - 1.")
    actions: list[str] = Field(description="Names of the actions, in the order of the logits.")
    terminal_actions: list[int] = Field(description="Indices of the actions that end the main task.")
    seed: int = Field(description="The seed from which, with t, each `action` is drawn.")
    threshold: float = Field(description="delta.")
    margin: float = Field(description="Robustness kept in reserve [the unit of the formula, m].")
    slack: int = Field(description="Steps kept in reserve.")
    evaluation: str = Field(description="`feasibility` or `robustness`.")
    shaping: str = Field(description="`projection`, or the name of a preference.")
    uncertainty: Uncertain = Field(
        "none", description="How exactly the robot is taken to move: `learned`, `none`, or as it was given."
    )
    learn_map: bool = Field(False, description="Whether motions that stop short mark what they ran into.")
    map_memory: int | None = Field(
        None, description="Steps after which an `occupied` point is forgotten; null: not because of its age."
    )
    threshold_over: str = Field("step", description="`step` or `episode`.")
    max_steps: int = Field(description="The last step that the session can have.")
    next_t: int = Field(description="The next step to ask for.")
    feasible: bool = Field(
        description="Whether some action had a satisfying future when the rule began to hold."
    )
    any_signal: bool | None = Field(
        None,
        description="Whether the rule could be kept whatever the signals do, when it began to hold. False: "
        "only if they stay as they are. Null: the rule reads no signals, or `uncertainty` is `none`.",
    )
    spec_status: SpecStatus = Field(description="The verdict on the history so far, whatever may follow.")
    main_task_done: bool = Field(description="Whether the last step said that the main task is done.")
    finished: bool = Field(description="Whether no further step will be decided.")
    created_at: str = Field(description="RFC 3339.")
    expires_at: str = Field(description="When the session is erased, RFC 3339; every change moves it on.")
    rules: list[SessionRule] = Field(
        description="Every rule of the session so far. The last is in force, and the fields above are of it."
    )


class SessionList(BaseModel):
    items: list[SessionResponse]
    next: str | None = Field(description="The `cursor` of the next page; null on the last page.")
