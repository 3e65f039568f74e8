"""Sessions: how they begin, and how they stand."""

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
    """The preferences that are installed where the description is made."""
    schema["enum"] = [PROJECTION, *PREFERENCES.names()]
    told = [f"`{name}`: {kind.about}" for name, kind in PREFERENCES.usable()]
    none = f"`{PROJECTION}`: the closest distribution that keeps the rule."
    schema["description"] = " ".join(["What the answer prefers within the rule.", none, *told])


class KnownUncertainty(Strict):
    """What is known of the robot before its first step."""

    translation: float = Field(
        ge=0.0,
        le=MOST_TRANSLATION,
        description="Standard deviation of where a motion leads, along each axis [m].",
    )
    rotation: float = Field(ge=0.0, le=math.pi, description="The same of its heading [rad].")
    slip: float = Field(0.0, ge=0.0, le=1.0, description="Probability that a motion is not executed at all.")


Uncertain = Literal["learned", "none"] | KnownUncertainty


class _Policies(Strict):
    """What names one policy, or several for one task."""

    policy_id: Id | None = Field(None, description="Id or name of the policy.")
    policy_ids: list[Id] | None = Field(
        None,
        min_length=1,
        max_length=8,
        fail_fast=True,
        description="Several policies for one task: an action is feasible if any says so.",
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

    initial_pose: Pose = Field(description="x_0: [m, m, rad], map frame; inside the map and free.")
    id: Id | None = Field(None, description="An id of your own; the server makes one up otherwise.")
    seed: int = Field(0, ge=0, lt=2**63, description="`action` is drawn from the seed and t.")
    threshold: float = Field(
        1.0,
        ge=0.0,
        description="delta, the least expected J of a step. With `feasibility` it is above 0 and at most 1; "
        "only 1 has the guarantee: 0.99^150 is 0.22. With `robustness` it is in metres, with no guarantee.",
    )
    margin: float = Field(
        0.0, ge=0.0, le=1e8, description="Robustness to keep in hand [the unit of the formula, m]."
    )
    slack: int = Field(
        0,
        ge=0,
        le=1000,
        description="Steps to keep in hand: what each F or U wants is done so much before its window ends, "
        "and what a G wants before it begins, if it can be.",
    )
    evaluation: Literal["feasibility", "robustness"] = Field(
        "feasibility",
        description="What J is: 1 or 0, for whether the rule can be kept (`feasibility`), or the robustness "
        "itself (`robustness`). The latter keeps no more than its mean at `threshold`, so actions that break "
        "the rule may keep some probability; where no action reaches the threshold, as often with 1 m, the "
        "answer is a `fallback`: choose one that fits the rule.",
    )
    shaping: Name = Field(PROJECTION, json_schema_extra=_describe_shaping)
    max_steps: int | None = Field(
        None, ge=1, description="The session ends there [steps]. Default: max(600, T + 1)."
    )
    allow_infeasible: bool = Field(False, description="Start even where no action has a satisfying future.")
    uncertainty: Uncertain = Field(
        "learned",
        description="`learned`: margin and slack of every decision follow from how the robot has moved so "
        "far. They begin cautious and let go as the world proves exact; a `margin` or `slack` given is the "
        "least that is kept. An object says what is known before the first step. `none`: the world is as "
        "told, as in the paper.",
    )
    learn_map: bool = Field(
        True, description="A motion that stops short of what was foreseen marks what it ran into."
    )
    map_memory: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="An `occupied` point is forgotten after so many steps; null: not for its age.",
    )
    threshold_over: Literal["step", "episode"] = Field(
        "step", description="Whether `threshold` holds at each step, or for the episode as a whole."
    )


class SwitchRequest(_Policies):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.SWITCH]})

    t: int = Field(ge=0, le=1_000_000, description="The first step that the new rule decides.")
    clock: Literal["keep", "restart"] = Field(
        "keep",
        description="`keep`: the new rule's windows count from where those of the present one do, at first "
        "the session's start, and its history counts. `restart`: both begin at t.",
    )
    poses: Poses | None = Field(
        None,
        description="Ends with x_t, joined as in a step. Without it, x_t is taken to be where the action of "
        "the last decision leads.",
    )


class SessionRule(BaseModel):
    begins: int = Field(alias="from", description="The first step that it decides, or decided.")
    origin: int = Field(description="The step from which its windows count.")
    clock: Literal["keep", "restart"] = Field(description="As the switch said; of the first one `restart`.")
    policy_ids: list[str] = Field(description="Ids of its policies.")
    map_id: str = Field(description="Id of its map.")
    formula: str = Field(description="The rule.")
    horizon: int = Field(description="In steps from `origin`.")
    actions: list[str] = Field(description="Names of its robot's actions, in the order of the logits.")
    terminal_actions: list[int] = Field(description="Indices of those that end the main task.")
    spec_status: SpecStatus = Field(
        description="Of the states from `origin` to the last one under this rule. `pending`: it was neither "
        "kept nor broken by then."
    )


class SessionResponse(BaseModel):
    id: str = Field(description="For the paths below /v1/sessions.")
    policy_ids: list[str] = Field(description="Ids of its policies.")
    map_id: str = Field(description="Id of its map.")
    spec: dict[str, JsonValue] = Field(
        description="`formula`, `signals` and, where one session is read, `regions`."
    )
    robot: RobotResponse | None = Field(None, description="Its robot, in full; not in lists.")
    horizon: int = Field(description="The horizon T in steps; the last shaped decision is at T - 1.")
    actions: list[str] = Field(description="Names, in the order of the logits.")
    terminal_actions: list[int] = Field(description="Indices of the actions that end the main task.")
    seed: int = Field(description="Of the draws of `action`.")
    threshold: float = Field(description="delta.")
    margin: float = Field(description="Robustness kept in hand [the unit of the formula, m].")
    slack: int = Field(description="Steps kept in hand.")
    evaluation: str = Field(description="`feasibility` or `robustness`.")
    shaping: str = Field(description="`projection`, or the name of a preference.")
    uncertainty: Uncertain = Field(
        "none", description="What is taken of how exactly the robot moves: `learned`, `none`, or as given."
    )
    learn_map: bool = Field(False, description="Whether motions that stop short mark what they ran into.")
    map_memory: int | None = Field(
        None, description="Steps after which an `occupied` point is forgotten; null: not for its age."
    )
    threshold_over: str = Field("step", description="`step` or `episode`.")
    max_steps: int = Field(description="The last step there can be.")
    next_t: int = Field(description="The step expected next.")
    feasible: bool = Field(
        description="Whether some action had a satisfying future where the rule began to hold."
    )
    any_signal: bool | None = Field(
        None,
        description="Whether, from where the rule began to hold, it is kept whatever the signals do. False: "
        "if they stay as they are. Null: the rule reads no signals, or `uncertainty` is `none`.",
    )
    spec_status: SpecStatus = Field(description="Of the history so far, whatever may follow.")
    main_task_done: bool = Field(description="As the last step said.")
    finished: bool = Field(description="No further step will be taken.")
    created_at: str = Field(description="RFC 3339.")
    expires_at: str = Field(description="RFC 3339; every change moves it on.")
    rules: list[SessionRule] = Field(
        description="Every rule that the session has had. The last is in force: the fields above are of it."
    )


class SessionList(BaseModel):
    items: list[SessionResponse]
    next: str | None = Field(description="`cursor` of the next page; null on the last.")
