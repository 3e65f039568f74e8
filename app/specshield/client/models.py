"""The service's answers as frozen dataclasses, whose fields have the names of the HTTP contract.

Lists become tuples. Metres, radians, counter-clockwise, map frame. Fields that this version does not know are
ignored, so a newer server may add some.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Generic, Literal, TypedDict, TypeVar

from specshield.errors import InputError, ServerError, SpecshieldError

T = TypeVar("T")
Pose = tuple[float, float, float]
SpecStatus = Literal["pending", "satisfied", "violated"]


@dataclass(frozen=True)
class Spec:
    """A formula that the server has parsed: canonical text, horizon [steps], the names in it, and the methods
    that can make policies for it.
    """

    formula: str
    horizon: int
    names: tuple[str, ...]
    methods: tuple[str, ...] = ()


@dataclass(frozen=True)
class Map:
    """An occupancy grid: resolution [m], size [cells], `origin` (x, y, yaw) of its lower-left corner."""

    id: str
    resolution: float
    width: int
    height: int
    origin: tuple[float, float, float]
    bounds: tuple[float, float, float, float]
    rooms: Mapping[str, Any]
    name: str | None = None


@dataclass(frozen=True)
class Policy:
    """What finds ways to keep a rule. progress: in [0, 1]. eta_s: estimated time left [s]. error: why it
    failed or waits. warnings: of a ready policy, such as a rule that no start can keep.
    """

    id: str
    status: Literal["queued", "training", "ready", "failed"]
    progress: float
    horizon: int
    metrics: Mapping[str, Any]
    error: str | None
    name: str | None = None
    eta_s: float | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class SessionInfo:
    """A session as the server described it; `next_t` is the step it expects next."""

    id: str
    policy_ids: tuple[str, ...]
    map_id: str
    spec: Mapping[str, Any]
    horizon: int
    actions: tuple[str, ...]
    terminal_actions: tuple[int, ...]  # indices of the actions that end the main task
    next_t: int
    feasible: bool
    spec_status: SpecStatus
    main_task_done: bool
    finished: bool
    expires_at: str
    margin: float = 0.0
    any_signal: bool | None = None  # whether the rule is kept whatever the signals do
    rules: tuple[Mapping[str, Any], ...] = ()  # by the contract's names; the last is in force


class Beginning(TypedDict, total=False):
    """The options of `sessions.create` beside `on_failure`, for type checkers; calls.py describes them."""

    initial_pose: Any
    policy_id: str | None
    policy_ids: Sequence[str] | None
    id: str | None
    seed: int
    threshold: float
    margin: float
    slack: int
    evaluation: Literal["feasibility", "robustness"]
    shaping: str
    max_steps: int | None
    allow_infeasible: bool
    uncertainty: Literal["learned", "none"] | Mapping[str, float]
    learn_map: bool
    map_memory: int | None
    threshold_over: Literal["step", "episode"]


@dataclass(frozen=True)
class Residual:
    """How far the robot is from the nearest pose that the last decision foresaw: [m], [rad]."""

    translation: float
    rotation: float


@dataclass(frozen=True)
class Explanation:
    """Why an action is forbidden. conjunct: the part of the rule that its best future does not keep.
    robustness: of that part [m]. late_by: by how many steps the future comes too late, None if time is not
    the reason. detail: more in words, such as which half of an `until` fails, and when.
    """

    conjunct: str
    robustness: float | None
    late_by: int | None
    detail: str | None = None

    def __str__(self) -> str:
        if self.is_kept:
            less = f"{self.conjunct} could still be kept, but with less to spare than the session asks for"
            return self.detail or less
        none = "no way was found after it that keeps the rule"
        told = f"{none}; the best way found does not keep '{self.conjunct}'"
        if self.detail is not None:
            return f"{told}: {self.detail}"
        if self.late_by is not None:
            return f"{told}: it comes {_steps(self.late_by)} too late"
        if self.robustness is None:
            return f"no way was found that keeps {self.conjunct}"
        return f"{told}: it falls short by {abs(self.robustness):.3g}"

    @property
    def is_kept(self) -> bool:
        """Whether the best future keeps the conjunct, but with less reserve than the session asks for."""
        return self.robustness is not None and self.robustness > 0.0

    def beside(self, margin: float, slack: int) -> str:
        """The explanation as a line for people, in a session with this margin [m] and slack [steps]."""
        if not self.is_kept or self.detail is not None:
            return str(self)
        if slack and self.late_by is not None:
            reserve = f"but not with the {_steps(slack)} in reserve that the session asks for"
            late = f"it comes {_steps(self.late_by)} too late for that"
            return f"{self.conjunct} could still be kept, {reserve}: {late}"
        if margin or slack:
            return f"{self} ({margin:.2g} m, {_steps(slack)})"
        return str(self)


def _steps(count: int) -> str:
    return f"{count} step{'s' if count != 1 else ''}"


@dataclass(frozen=True)
class Decision:
    """The decision of step `t`. Sequences without a comment have one entry for each action.

    `execute` is the action to run: the drawn `action`, but `completion_action` if the drawn one ends the main
    task (a terminal action) while the rule is pending. Once the rule is settled and the main task over,
    `execute` is the terminal action: nothing is left to do.
    """

    t: int
    mode: Literal["prior", "shaped", "completion", "fallback", "violated"]
    distribution: tuple[float, ...]
    j_values: tuple[float | None, ...]
    robustness: tuple[float | None, ...]
    action: int
    action_name: str
    completion_action: int | None
    spec_status: SpecStatus
    feasible_mass: float | None
    kl: float | None
    reason: str | None
    finished: bool
    in_collision: bool  # the robot touches an obstacle
    next_poses: tuple[Pose, ...]
    residual: Residual | None
    witness: tuple[int, ...] | None  # the actions that follow `execute`, to the horizon
    execute: int
    timings: Mapping[str, float]  # [ms], from the Server-Timing header
    witnesses: tuple[tuple[int, ...] | None, ...] | None = None
    warnings: tuple[str, ...] = ()  # what did not go as it should, such as a policy that was not used
    margin: float = 0.0  # [m] the robustness above 0 that J asked for
    slack: int = 0  # [steps] the reserve before deadlines that J asked for
    threshold_left: float = 1.0  # of the next step
    map_revision: int = 0  # how often the session's own map has changed
    any_signal: bool | None = None  # whether the rule is kept whatever the signals do from here on
    explanations: tuple[Explanation | None, ...] | None = None  # of each forbidden action, if asked for
    action_names: tuple[str, ...] = field(default=(), repr=False)
    source: Literal["service"] = "service"

    def why(self, action: int | str) -> str:
        """Why an action, given by its index or its name, is forbidden, as a line for people: "m is forbidden:
        no way was found after it that keeps the rule; the best way found does not keep 'F[50,100] Region2':
        'Region2' is met at step 104, 4 steps too late". The step needs explain=True for that.

        Raises InputError for an action that does not exist.
        """
        count = len(self.j_values)
        i: Any = self.action_names.index(action) if action in self.action_names else action
        if not hasattr(i, "__index__") or not 0 <= i < count:
            names = ", ".join(self.action_names)
            expected = f"an index from 0 to {count - 1}, or one of {names}"
            raise InputError("there is no such action", path="action", got=action, expected=expected)
        name = self.action_names[i] if self.action_names else f"action {i}"
        if self.explanations is None:
            return f"{name}: the step was not asked to explain (explain=True)"
        told = self.explanations[i]
        if told is None:
            return f"{name} is not forbidden"
        return f"{name} is forbidden: {told.beside(self.margin, self.slack)}"


@dataclass(frozen=True)
class LocalDecision:
    """What `step` returns if the service cannot answer and `on_failure` is not "raise". Nothing was shaped.

    source "witness": `execute` is the next action of the latest certified continuation. The step counts: its
    pose is recorded, and sent to the service later. source "stop": no certified action is known, so `execute`
    is None and the robot should stand. The step does not count: `t` stays, and a later `step` asks for it
    again. `reason` says why no action is known, `error` why the service did not answer (None: it was away a
    moment ago and was not asked this time).
    """

    t: int
    source: Literal["witness", "stop"]
    execute: int | None
    reason: str
    spec_status: SpecStatus  # of the service's last answer
    witness: tuple[int, ...] | None = None  # the actions that follow `execute` to the horizon
    next_pose: Pose | None = None  # where `execute` should lead
    finished: bool = False
    error: SpecshieldError | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Verdict:
    """How a closed session ended. Bounds: the rule's robustness at worst and at best; None is infinite."""

    spec_status: SpecStatus
    robustness_bounds: tuple[float | None, float | None]


@dataclass(frozen=True)
class TrajectoryItem:
    """The state at `t`, and the answer given there (the contract's names), None for a step without one."""

    t: int
    pose: Pose
    signals: Mapping[str, float]
    decision: Mapping[str, Any] | None
    rule: int = 0  # index of the rule, among the session's `rules`, that decides or decided this step


@dataclass(frozen=True)
class Learned:
    """What a session had learned of its map by step `t`: cells `row * width + column`, row 0 the lowest."""

    t: int
    map_id: str
    map_revision: int
    occupied: tuple[int, ...]
    free: tuple[int, ...]


@dataclass(frozen=True)
class Page(Generic[T]):
    """One page of a list; `next` is the cursor of the next page."""

    items: tuple[T, ...]
    next: str | None


def build(cls: type[T], body: Mapping[str, Any], **more: Any) -> T:
    """An object of `cls` from the members of `body` that it knows. Raises ServerError if one is missing."""
    known = {f.name for f in fields(cls)} - more.keys()  # type: ignore[arg-type]
    try:
        return cls(**{name: _tuples(value) for name, value in body.items() if name in known}, **more)
    except (AttributeError, TypeError) as error:
        told = f"the server sent a {cls.__name__.lower()} that this client does not understand: {error}"
        raise ServerError(told, got=body, expected="what a specshield server answers") from error


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def execute_of(body: Mapping[str, Any], terminal: Sequence[int], over: bool) -> Any:
    """`Decision.execute` of an answer. terminal: the terminal actions. over: whether the main task is."""
    action, pending = body.get("action"), body.get("spec_status") == "pending"
    if pending:
        return body.get("completion_action") if action in terminal else action
    return terminal[0] if over and terminal else action


def decision_of(
    body: Mapping[str, Any], rule: Mapping[str, Any], over: bool, timings: Mapping[str, float]
) -> Decision:
    """The decision that an answer holds (the contract's names). rule: with the `actions` and
    `terminal_actions` for which it was made. over: whether the main task is over.
    """
    residual, told = body.get("residual"), body.get("explanations")
    explained = [None if why is None else build(Explanation, why) for why in told or ()]
    return build(
        Decision,
        body,
        residual=None if residual is None else build(Residual, residual),
        explanations=None if told is None else tuple(explained),
        timings=timings,
        execute=execute_of(body, rule["terminal_actions"], over),
        action_names=tuple(rule["actions"]),
        source="service",
    )
