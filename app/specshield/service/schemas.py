"""What the HTTP contract takes and gives. Metres, radians counter-clockwise, map frame (REP-103)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, JsonValue, Tag, model_validator

from specshield.service import examples

SpecStatus = Literal["pending", "satisfied", "violated"]
Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Coordinate = Annotated[float, Field(ge=-1e8, le=1e8)]
Pose = Annotated[
    list[Coordinate], Field(min_length=3, max_length=3, description="[x, y, theta]: [m, m, rad], map frame.")
]
Point = Annotated[
    list[Coordinate], Field(min_length=2, max_length=2, description="[x, y] in metres, map frame.")
]
Name = Annotated[str, Field(min_length=1, max_length=64)]


class Strict(BaseModel):
    """Requests: no unknown fields, no conversions, no NaN or infinity."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, protected_namespaces=())


class Answer(BaseModel):
    model_config = ConfigDict(protected_namespaces=())


# --- problems


class FieldError(Answer):
    path: str = Field(description="The field: `poses[0][2]`.")
    got: JsonValue = Field(None, description="What it held, shortened.")
    expected: str = Field(description="What is valid.")


class Problem(Answer):
    """An error, as RFC 9457 has it. Other members may follow, such as `position` or `expected_t`."""

    model_config = ConfigDict(extra="allow", json_schema_extra={"examples": [examples.PROBLEM]})

    type: str = Field(description="A stable word to branch on, such as `history-gap`.")
    title: str = Field(description="The word, readable.")
    status: int = Field(description="The HTTP status.")
    detail: str = Field(description="What was wrong, for a person.")
    path: str | None = Field(None, description="The field at fault.")
    got: JsonValue = Field(None, description="What the field held, shortened.")
    expected: str | None = Field(None, description="What is valid there.")
    errors: list[FieldError] | None = Field(
        None, description="Every field that failed, where there are several."
    )


class Health(Answer):
    status: Literal["ok"]


# --- specifications


class Circle(Strict):
    type: Literal["circle"]
    center: Point
    radius: float = Field(gt=0, le=1e8, description="In metres.")


class Rectangle(Strict):
    """Axis-parallel, in the map frame."""

    type: Literal["rectangle"]
    min: Point
    max: Point


class Polygon(Strict):
    """Simple: the edges touch only at their ends. The last vertex joins the first."""

    type: Literal["polygon"]
    vertices: list[Point] = Field(min_length=3, max_length=10_000, description="In order, [x, y] in metres.")


Shape = Annotated[Circle | Rectangle | Polygon, Field(discriminator="type")]


class Union(Strict):
    """Everything inside any member."""

    type: Literal["union"]
    members: list[Shape] = Field(min_length=1, max_length=256, description="Regions that are no unions.")


Region = Annotated[Circle | Rectangle | Polygon | Union, Field(discriminator="type")]
Regions = Annotated[
    dict[str, Region],
    Field(
        max_length=256,
        description="Regions by name; in a formula a name is the signed distance [m], positive inside.",
    ),
]
Signals = Annotated[
    dict[str, float],
    Field(
        max_length=64,
        description="Other signals by name, each with the value it holds before its first sample.",
    ),
]
Formula = Annotated[
    str,
    Field(
        min_length=1,
        max_length=10_000,
        description="Signal temporal logic: `F[0,60] (Charger1 or Charger2) and G[0,150] not Forbidden`.",
    ),
]


class SpecRequest(Strict):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.SPEC_REQUEST]})

    formula: Formula
    regions: Regions | None = Field(None, description="Regions by name.")
    signals: Signals | None = Field(None, description="Initial values of other signals, by name.")
    map_id: Id | None = Field(None, description="A map, whose rooms are then names too.")


class SpecResponse(Answer):
    formula: str = Field(description="Canonical text; it parses back to an equal formula.")
    horizon: int = Field(description="The horizon T in steps: T + 1 states decide the formula.")
    names: list[str] = Field(description="The names it uses, sorted.")


class Spec(Strict):
    formula: Formula
    regions: Regions = Field(default_factory=dict)
    signals: Signals = Field(default_factory=dict)


# --- maps


class HouseMap(Strict):
    """A ProcTHOR house. Map (x, y) is the house's (x, z) in metres; theta = pi/2 - yaw."""

    format: Literal["procthor"]
    house: dict[str, Any] = Field(description="The house's JSON.")
    asset_sizes: dict[str, Any] = Field(
        description="Bounding box of every asset it uses, by asset id: x, y, z [m]."
    )
    resolution: float = Field(0.05, gt=0, description="Side of a cell [m].")


class GridMap(Strict):
    """A nav_msgs/OccupancyGrid. Unknown cells (-1) count as occupied, and so does all outside the map."""

    format: Literal["occupancy_grid"]
    info: dict[str, Any] = Field(
        description="`resolution` [m], `width`, `height` [cells], `origin`: {position, orientation}."
    )
    data: list[int] = Field(description="Row-major from the lowest y: -1 unknown, 0..100 occupancy [%].")


MapUpload = Annotated[HouseMap | GridMap, Field(discriminator="format")]


class MapResponse(Answer):
    id: str = Field(description="Hash of the content.")
    name: str | None = Field(description="Its name, if it came with the server; accepted wherever an id is.")
    resolution: float = Field(description="Side of a cell [m].")
    width: int = Field(description="Cells along x.")
    height: int = Field(description="Cells along y.")
    origin: list[float] = Field(description="[x, y, yaw] of the lower-left corner: [m, m, rad].")
    bounds: list[float] = Field(description="[xmin, ymin, xmax, ymax] in metres, map frame.")
    rooms: dict[str, Region] = Field(description="Named areas; their names can be used in formulas.")


class MapList(Answer):
    items: list[MapResponse]
    next: str | None = Field(description="`cursor` of the next page; null on the last.")


# --- robots and policies


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
    actions: list[ActionSpec] = Field(min_length=1, max_length=256)


RobotChoice = Annotated[
    Annotated[Name, Tag("name")] | Annotated[RobotSpec, Tag("robot")],
    Discriminator(lambda value: "name" if isinstance(value, str) else "robot"),
]


class PolicyRequest(Strict):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.POLICY]})

    map_id: Id = Field(description="Id or name of the map.")
    robot: RobotChoice = Field("stretch", description="A preset (`stretch`) or a robot of your own.")
    spec: Spec
    method: Literal["dqn", "planner", "reachability"] = Field(
        "reachability",
        description="How the policy is made: computed in seconds, for the fragment (`reachability`) or any "
        "formula (`planner`), or learned in minutes (`dqn`).",
    )
    seed: int = Field(0, ge=0, lt=2**63, description="Of everything random in the training.")
    options: dict[str, bool | int | float | str | list[float]] = Field(
        default_factory=dict,
        max_length=64,
        description="Settings of the method that differ from its defaults.",
    )


class Card(BaseModel):
    """What has to be in a policy's card.json; whatever else it tells is kept."""

    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)

    map_id: Id
    robot: RobotChoice
    spec: Spec
    method: Literal["dqn", "planner", "reachability"]
    seed: int = Field(ge=0, lt=2**63)
    options: dict[str, bool | int | float | str | list[float]] = Field(max_length=64)
    task_hash: Name
    metrics: dict[str, JsonValue] = Field(max_length=256)


class PolicyResponse(Answer):
    id: str = Field(description="Hash of task, method, options and seed.")
    name: str | None = Field(description="Its name, if it came with the server; accepted wherever an id is.")
    status: Literal["queued", "training", "ready", "failed"] = Field(description="Sessions need `ready`.")
    progress: float = Field(description="0 to 1.")
    eta_s: float | None = Field(description="Estimate of the time left [s]; null where there is none.")
    error: str | None = Field(description="Why it failed.")
    metrics: dict[str, JsonValue] = Field(description="What was measured, such as the rate of satisfaction.")
    map_id: str = Field(description="Id of the map.")
    robot: str | dict[str, JsonValue] = Field(description="A preset's name, or the robot as it was sent.")
    spec: dict[str, JsonValue] = Field(description="`formula`, `regions`, `signals`.")
    horizon: int = Field(description="The horizon T in steps.")
    method: str = Field(description="How it is made.")
    seed: int = Field(description="As asked for.")
    options: dict[str, JsonValue] = Field(description="Every setting of the method.")
    created_at: str | None = Field(description="RFC 3339; null for one that came with the server.")


class PolicyList(Answer):
    items: list[PolicyResponse]
    next: str | None = Field(description="`cursor` of the next page; null on the last.")


# --- sessions


class SessionRequest(Strict):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.SESSION]})

    policy_id: Id | None = Field(None, description="Id or name of the policy.")
    policy_ids: list[Id] | None = Field(
        None,
        min_length=1,
        max_length=8,
        description="Several policies for one task: an action is feasible if any says so.",
    )
    initial_pose: Pose = Field(description="x_0: [m, m, rad], map frame; inside the map and free.")
    id: Id | None = Field(None, description="An id of your own; the server makes one up otherwise.")
    seed: int = Field(0, ge=0, lt=2**63, description="`action` is drawn from the seed and t.")
    threshold: float = Field(
        1.0,
        gt=0.0,
        description="delta, the least expected J of a step. The guarantee is for 1 with evaluation "
        "`feasibility`: 0.99^150 is 0.22. With `robustness` it is in metres and guarantees nothing.",
    )
    margin: float = Field(
        0.0, ge=0.0, le=1e8, description="Robustness to keep in hand [the unit of the formula, m]."
    )
    slack: int = Field(
        0,
        ge=0,
        le=1000,
        description="Steps to keep in hand: each F of the conjunction is met so much earlier, if it can be.",
    )
    evaluation: Literal["feasibility", "robustness"] = Field(
        "feasibility",
        description="What J is: 1 or 0, for whether the rule can be kept (`feasibility`), or the robustness "
        "itself (`robustness`). The latter keeps no more than its mean at `threshold`, so actions that break "
        "the rule may keep some probability; where no action reaches the threshold, as often with 1 m, the "
        "answer is a `fallback`: choose one that fits the rule.",
    )
    shaping: Literal["projection", "lookahead"] = Field(
        "projection",
        description="How the prior is bent. `lookahead` is for formulas that `reachability` takes.",
    )
    max_steps: int | None = Field(
        None, ge=1, description="The session ends there [steps]. Default: max(600, T + 1)."
    )
    allow_infeasible: bool = Field(False, description="Start even where no action has a satisfying future.")

    @model_validator(mode="after")
    def _one_way_to_name_policies(self) -> SessionRequest:
        if (self.policy_id is None) == (self.policy_ids is None):
            raise ValueError("exactly one of policy_id and policy_ids")
        return self

    @property
    def policies(self) -> list[str]:
        return self.policy_ids or [str(self.policy_id)]


class SessionResponse(Answer):
    id: str = Field(description="For the paths below /v1/sessions.")
    policy_ids: list[str] = Field(description="Ids of its policies.")
    map_id: str = Field(description="Id of its map.")
    spec: dict[str, JsonValue] = Field(description="`formula`, `regions`, `signals`.")
    horizon: int = Field(description="The horizon T in steps; the last shaped decision is at T - 1.")
    actions: list[str] = Field(description="Names, in the order of the logits.")
    terminal_actions: list[int] = Field(description="Indices of the actions that end the main task.")
    seed: int = Field(description="Of the draws of `action`.")
    threshold: float = Field(description="delta.")
    margin: float = Field(description="Robustness kept in hand [the unit of the formula, m].")
    slack: int = Field(description="Steps kept in hand.")
    evaluation: str = Field(description="`feasibility` or `robustness`.")
    shaping: str = Field(description="`projection` or `lookahead`.")
    max_steps: int = Field(description="The last step there can be.")
    next_t: int = Field(description="The step expected next.")
    feasible: bool = Field(description="Whether some action from x_0 had a satisfying future.")
    spec_status: SpecStatus = Field(description="Of the history so far, whatever may follow.")
    main_task_done: bool = Field(description="As the last step said.")
    finished: bool = Field(description="No further step will be taken.")
    created_at: str = Field(description="RFC 3339.")
    expires_at: str = Field(description="RFC 3339; every change moves it on.")


class SessionList(Answer):
    items: list[SessionResponse]
    next: str | None = Field(description="`cursor` of the next page; null on the last.")


class StepRequest(Strict):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.STEP]})

    t: int = Field(
        ge=0,
        le=1_000_000,
        description="The step to decide. It is the lock: sent again, it returns the stored answer.",
    )
    poses: list[Pose] = Field(
        min_length=1,
        max_length=10_001,
        description="Ends with x_t; the whole history or any newest part that joins what the server has.",
    )
    logits: list[float | None] | None = Field(
        None,
        max_length=256,
        description="Logits, one an action; null is minus infinity. Not needed after the main task.",
    )
    main_task_done: bool = Field(False, description="The main task is over; stays true once it is.")
    signals: dict[str, float] | None = Field(
        None,
        max_length=64,
        description="Samples at t of the signals that the spec declares; one left out holds its last value.",
    )
    witnesses: bool = Field(False, description="Answer a certified continuation for every action.")


class Residual(Answer):
    translation: float = Field(description="In metres.")
    rotation: float = Field(description="In radians.")


class StepResponse(Answer):
    t: int = Field(description="The step that was decided.")
    mode: Literal["prior", "shaped", "completion", "fallback", "violated"] = Field(
        description="How `distribution` came about."
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
        description="How far x_t is from where the executed action should have led."
    )
    witness: list[int] | None = Field(description="Action indices that follow `action` to the horizon.")
    witnesses: list[list[int] | None] | None = Field(
        None, description="The same for each action, if asked for."
    )


class CloseRequest(Strict):
    model_config = ConfigDict(json_schema_extra={"examples": [examples.CLOSE]})

    t: int | None = Field(
        None, ge=0, le=1_000_000, description="The last step reached. Default: the last one stored."
    )
    poses: list[Pose] | None = Field(
        None, min_length=1, max_length=10_001, description="Ends with x_t, joined as in a step."
    )

    @model_validator(mode="after")
    def _both_or_neither(self) -> CloseRequest:
        if (self.t is None) != (self.poses is None):
            raise ValueError("t and poses come together")
        return self


class CloseResponse(SessionResponse):
    robustness_bounds: list[float | None] = Field(
        description="[lo, hi] on the robustness over every continuation; equal at the horizon; null: none."
    )


class TrajectoryItem(Answer):
    t: int = Field(description="The step.")
    pose: Pose
    signals: dict[str, float] = Field(description="The samples held at t.")
    decision: StepResponse | None = Field(
        description="The answer given; null for a pose sent later or by close."
    )


class Trajectory(Answer):
    items: list[TrajectoryItem]
    next: None = Field(None, description="Always null: a trajectory is one page.")
