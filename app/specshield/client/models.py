"""What the service answers, as frozen dataclasses whose fields are named as in the HTTP contract.

Lists arrive as tuples. Metres, radians, counter-clockwise, map frame. Fields this version does not
know are ignored, so a newer server may add some.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Generic, Literal, TypedDict, TypeVar

from specshield.errors import InputError, ServerError, SpecshieldError

T = TypeVar("T")
Pose = tuple[float, float, float]
SpecStatus = Literal["pending", "satisfied", "violated"]


@dataclass(frozen=True)
class Spec:
    """A formula the server has parsed: canonical text, horizon [steps], the names it uses, the methods that
    take such a rule.
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
    """A policy pi_phi: `progress` in [0, 1], `eta_s` the estimated time left [s], `error` why it failed
    or waits, `warnings` what there is to know of one that is ready, such as a rule that no start can keep.
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
    terminal_actions: tuple[int, ...]  # indices of those that end the main task
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
    """What `sessions.create` takes beside `on_failure`, for type checkers (calls.py says what each is)."""

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
    """How far x_t lies from the nearest pose that the last decision foresaw: [m], [rad]."""

    translation: float
    rotation: float


@dataclass(frozen=True)
class Explanation:
    """Why an action is forbidden: the part of the rule that its best future does not keep, its robustness
    there [m], and by how many steps that future comes too late (None where time is not what is missing).
    detail: what else there is to say, such as which half of an `until` fails, and when.
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
        return f"{told}: it misses it by {abs(self.robustness):.3g}"

    @property
    def is_kept(self) -> bool:
        """Whether the best future keeps it, though not as the session asks for."""
        return self.robustness is not None and self.robustness > 0.0

    def beside(self, margin: float, slack: int) -> str:
        """The line for people, in a session that asks for a margin [m] and slack [steps] beyond the rule."""
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
    """One decision at step `t`; the sequences without a comment have one entry an action.

    `execute` is the action to run: `action` as drawn, except that a terminal one is never run while
    the specification is pending (then it is `completion_action`), and that once the specification is
    settled and the main task over it is the terminal action: nothing is left to do.
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
    in_collision: bool  # x_t touches an obstacle
    next_poses: tuple[Pose, ...]
    residual: Residual | None
    witness: tuple[int, ...] | None  # the actions that follow `action` to the horizon
    execute: int
    timings: Mapping[str, float]  # [ms], from the Server-Timing header
    witnesses: tuple[tuple[int, ...] | None, ...] | None = None
    warnings: tuple[str, ...] = ()  # what did not go as it should, such as a policy that was not used
    margin: float = 0.0  # [m] the robustness above 0 that J asked for
    slack: int = 0  # [steps] that J asked to keep in hand
    threshold_left: float = 1.0  # of the next step
    map_revision: int = 0  # how often the session's own map has changed
    any_signal: bool | None = None  # whether the rule is kept whatever the signals do from here on
    explanations: tuple[Explanation | None, ...] | None = None  # of each forbidden action, if asked for
    action_names: tuple[str, ...] = field(default=(), repr=False)
    source: Literal["service"] = "service"

    def why(self, action: int | str) -> str:
        """Why an action, by its index or its name, is forbidden, in a line for people: "m is forbidden: no
        way was found after it that keeps the rule; the best way found does not keep 'F[50,100] Region2':
        'Region2' is met at step 104, 4 steps too late". The step has to have asked: explain=True.

        Raises InputError for an action that there is not.
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
        why = told.beside(self.margin, self.slack)
        called = ", should its signals call for it" if self.any_signal and "->" in told.conjunct else ""
        return f"{name} is forbidden: {why}{called}"


@dataclass(frozen=True)
class LocalDecision:
    """What a step is when the service cannot answer it, and `on_failure` is not "raise". Nothing was shaped.

    source "witness": `execute` is the next action of the certified continuation received last. The step
    counts: its pose is recorded, and told to the service later. source "stop": there is nothing certified to
    do, so `execute` is None: the robot should stand. The step does not count: `t` stays, and a later `step`
    asks for it anew. `reason` says why there is nothing, `error` why the service did not answer (None: it was
    away a moment ago and was not asked this time).
    """

    t: int
    source: Literal["witness", "stop"]
    execute: int | None
    reason: str
    spec_status: SpecStatus  # as the service said last
    witness: tuple[int, ...] | None = None  # the actions that follow `execute` to the horizon
    next_pose: Pose | None = None  # where `execute` should lead
    finished: bool = False
    error: SpecshieldError | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Verdict:
    """How a closed session ended; the bounds are those of rho over all continuations, null is infinite."""

    spec_status: SpecStatus
    robustness_bounds: tuple[float | None, float | None]


@dataclass(frozen=True)
class TrajectoryItem:
    """The state at `t`, and the answer given there by the contract's names; None where none was asked for."""

    t: int
    pose: Pose
    signals: Mapping[str, float]
    decision: Mapping[str, Any] | None
    rule: int = 0  # which of the session's `rules` decides, or decided, this step


@dataclass(frozen=True)
class Learned:
    """What a session knew of its map at step `t`: cells `row * width + column`, row 0 the lowest."""

    t: int
    map_id: str
    map_revision: int
    occupied: tuple[int, ...]
    free: tuple[int, ...]


@dataclass(frozen=True)
class Page(Generic[T]):
    """One page of a list; `next` asks for the following one."""

    items: tuple[T, ...]
    next: str | None


def build(cls: type[T], body: Mapping[str, Any], **more: Any) -> T:
    """`cls` from the members of `body` it knows; ServerError where one is missing."""
    known = {f.name for f in fields(cls)} - more.keys()  # type: ignore[arg-type]
    try:
        return cls(**{name: _tuples(value) for name, value in body.items() if name in known}, **more)
    except (AttributeError, TypeError) as error:
        told = f"the server answered a {cls.__name__.lower()} that this client does not understand: {error}"
        raise ServerError(told, got=body) from error


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def execute_of(body: Mapping[str, Any], terminal: Sequence[int], over: bool) -> Any:
    """`Decision.execute` of an answer. terminal: the actions that end the main task. over: whether it is."""
    action, pending = body.get("action"), body.get("spec_status") == "pending"
    if pending:
        return body.get("completion_action") if action in terminal else action
    return terminal[0] if over and terminal else action


def decision_of(
    body: Mapping[str, Any], info: SessionInfo, over: bool, timings: Mapping[str, float]
) -> Decision:
    """Of an answer by the contract's names. over: whether the main task is."""
    residual, told = body.get("residual"), body.get("explanations")
    explained = [None if why is None else build(Explanation, why) for why in told or ()]
    return build(
        Decision,
        body,
        residual=None if residual is None else build(Residual, residual),
        explanations=None if told is None else tuple(explained),
        timings=timings,
        execute=execute_of(body, info.terminal_actions, over),
        action_names=info.actions,
        source="service",
    )


def under(info: SessionInfo, rules: Sequence[Mapping[str, Any]], t: int) -> SessionInfo:
    """The session with the actions of the robot that step t was decided for."""
    rule = next((rule for rule in reversed(rules) if rule["from"] <= t), None)
    if rule is None:
        return info
    return replace(info, actions=tuple(rule["actions"]), terminal_actions=tuple(rule["terminal_actions"]))
