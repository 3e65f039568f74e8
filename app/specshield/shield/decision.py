"""What goes into a decision and what comes out of one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from specshield.arrays import Floats
from specshield.compiled import Boxed
from specshield.errors import InputError, PolicyError
from specshield.robot.dynamics import Body, make_body
from specshield.rule.view import View, view_of
from specshield.shield.preference import Preference
from specshield.shield.proposal import Proposer
from specshield.shield.uncertainty import Uncertainty
from specshield.stl import Verdict
from specshield.task import Task

Mode = Literal["prior", "shaped", "completion", "fallback", "violated"]
Reason = Literal["infeasible", "zero_prior_mass", "margin_unattainable"]
USUAL_STEPS = 600  # that a session has at least, unless it says a number. Chosen by hand.
ThresholdOver = Literal["step", "episode"]


@dataclass(frozen=True)
class Config:
    """A session's settings. Raises InputError with the field's path.

    threshold: delta. It is in (0, 1] if `evaluation` is "feasibility", any number of metres if that is
    "robustness". margin: J asks for rho > margin [m]. slack: J asks for everything that has a deadline this
    many steps early. Where no future has the margin or the slack, J asks for as much of it as some future
    has. max_steps: None stands for max(600, T + 1). seed: of the draws of actions.

    uncertainty: None takes f for exact, as the paper does. Otherwise margin and slack follow from what the
    session knows and learns of its robot, and the two settings above are lower limits. threshold_over:
    whether delta holds at each `step` or over the whole `episode`. learn_map: whether a motion that stops
    short marks what it ran into. map_memory: after how many steps an `occupied` point is forgotten; None: no
    point is forgotten because of its age. any_signal: J asks that the rule be kept whatever the signals do,
    if some action allows that. Otherwise, and without this setting, signals are taken to keep their values,
    as in the paper.
    """

    threshold: float = 1.0
    margin: float = 0.0
    slack: int = 0
    evaluation: str = "feasibility"
    max_steps: int | None = None
    seed: int = 0
    uncertainty: Uncertainty | None = None
    threshold_over: ThresholdOver = "step"
    learn_map: bool = False
    map_memory: int | None = None
    any_signal: bool = False

    def __post_init__(self) -> None:
        if self.evaluation not in ("feasibility", "robustness"):
            told, expected = "unknown evaluation", "'feasibility' or 'robustness'"
            raise InputError(told, path="evaluation", got=self.evaluation, expected=expected)
        binary = self.evaluation == "feasibility"
        if not math.isfinite(self.threshold) or (binary and not 0.0 < self.threshold <= 1.0):
            told = "the threshold is out of range"
            expected = "above 0 and at most 1" if binary else "a finite number of metres"
            raise InputError(told, path="threshold", got=self.threshold, expected=expected)
        for name, value, unit in (("margin", self.margin, "metres"), ("slack", self.slack, "steps")):
            if not (math.isfinite(value) and value >= 0):
                told = f"the {name} is out of range"
                raise InputError(told, path=name, got=value, expected=f"0 or more {unit}")
        if self.threshold_over == "episode" and not binary:
            told = "a threshold over the episode is a probability, and evaluation 'robustness' has metres"
            expected = "'step', or evaluation 'feasibility'"
            raise InputError(told, path="threshold_over", got="episode", expected=expected)
        if self.map_memory is not None and self.map_memory < 1:
            told, expected = "the map's memory is out of range", "1 or more steps, or null for no limit"
            raise InputError(told, path="map_memory", got=self.map_memory, expected=expected)


@dataclass(frozen=True)
class Shield:
    """A task, the policies that propose futures for it and a session's settings, prepared once.

    Raises InputError where a preference is given to a session that does not choose within S_t.
    """

    task: Task
    proposers: tuple[Proposer, ...]
    config: Config
    body: Body = field(repr=False)
    view: Boxed[View] = field(repr=False)
    preference: Preference | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.preference is not None:
            check_preferring(self.config)

    @property
    def max_steps(self) -> int:
        return self.config.max_steps or max(USUAL_STEPS, self.task.horizon + 1)


def check_preferring(config: Config) -> None:
    """Raises InputError for settings under which a session does not choose within S_t alone."""
    if config.evaluation != "feasibility" or config.threshold != 1.0:
        told = "a preference chooses within the feasible set, and these settings leave mass outside it"
        got = f"evaluation {config.evaluation!r}, threshold {config.threshold:g}"
        expected = "shaping 'projection', or evaluation 'feasibility' with threshold 1"
        raise InputError(told, path="shaping", got=got, expected=expected)


def make_shield(
    proposers: Sequence[Proposer], config: Config | None = None, preference: Preference | None = None
) -> Shield:
    """A shield for the task that the proposers share. Raises PolicyError where they do not share one."""
    if not proposers:
        expected = "at least one policy"
        raise PolicyError("a shield needs a policy", path="policy_ids", got=[], expected=expected)
    task = proposers[0].task
    for i, policy in enumerate(proposers):
        if policy.task.content_hash != task.content_hash:
            told = "the policies were made for different tasks"
            expected = f"task {task.content_hash}, as policy_ids[0]"
            raise PolicyError(told, path=f"policy_ids[{i}]", got=policy.task.content_hash, expected=expected)
    body, view = make_body(task.robot, task.grid), view_of(task, task.formula)
    return Shield(task, tuple(proposers), config or Config(), body, view, preference)


# A pose, and the index of a motion that led nowhere from it. The index is inverted (~motion) if the motion
# did nothing, but may only have slipped.
Stuck = tuple[float, float, float, int]


class Carry(NamedTuple):
    """What one decision hands to the next.

    next_poses [M, 3]: where f leads by each motion. witnesses: for each motion the T - t - 1 motions that
    follow it, one a byte; None if it is neither certified, nor begun while none is, nor has a chance by a
    threshold over the episode. memory: of the session's preference. residuals: what the session has seen of
    its robot (`Seen` in caution/experience.py). threshold_left: what is left of a threshold over the episode.
    learned: what the session has learned of its map (`Taught.to_bytes`). action: the one that was drawn,
    which the caller may have executed. way: where a rule begins to hold, and a search found a way but no
    policy did, the motions of that way to the horizon, one a byte. stuck, here: see `Taught`.
    """

    t: int
    next_poses: Floats
    witnesses: tuple[bytes | None, ...]
    memory: bytes | None = None
    residuals: bytes | None = None
    threshold_left: float | None = None
    learned: bytes | None = None
    action: int | None = None
    way: bytes | None = None
    stuck: tuple[Stuck, ...] = ()
    here: int = 0


@dataclass(frozen=True)
class Explanation:
    """Why an action is forbidden.

    conjunct: the part of the formula that its best future does not keep. robustness: of that part along that
    future [m]. late_by: by how many steps the future comes too late; None if more time would not help.
    detail: the reason in words; None if there is nothing to add.
    """

    conjunct: str
    robustness: float
    late_by: int | None
    detail: str | None = None


class Decision(NamedTuple):
    """The answer to one step, for A actions. The fields are those of the HTTP contract.

    distribution [A]: pi*. j_values, robustness [A]: None where nothing was evaluated; robustness is rho of
    the joint trajectory that certifies (or fails) the action [m]. feasible_mass: pi_FM(S_t). kl: of the
    answer from the prior [nats]; None if the answer leaves the prior's support or no logits were sent.
    next_poses [A, 3]: where f leads by each action. residual: how far x_t is from the nearest pose that the
    last decision foresaw, in metres and radians; None if there is no such pose. witness: the actions that
    follow `action`, by index; witnesses: the same for every action. warnings: what did not go as it should,
    such as a policy that was not used.

    margin [m], slack [steps]: what J asked for at this step. threshold_left: the threshold of the next step,
    as a share of the best chance that it has. map_revision: how often the session's map has changed.
    any_signal: whether every action that J allows has a future that keeps the rule whatever the signals do
    from here on; None if that was not asked or the rule reads no signals. explanations [A]: None for an
    action that is allowed; empty if they were not asked for.
    """

    t: int
    mode: Mode
    distribution: Floats
    j_values: tuple[float | None, ...]
    robustness: tuple[float | None, ...]
    action: int
    action_name: str
    completion_action: int | None
    spec_status: Verdict
    feasible_mass: float | None
    kl: float | None
    reason: Reason | None
    finished: bool
    next_poses: Floats
    residual: tuple[float, float] | None
    in_collision: bool
    witness: tuple[int, ...] | None
    witnesses: tuple[tuple[int, ...] | None, ...]
    warnings: tuple[str, ...]
    margin: float
    slack: int
    threshold_left: float
    map_revision: int
    any_signal: bool | None
    explanations: tuple[Explanation | None, ...]
    carry: Carry
