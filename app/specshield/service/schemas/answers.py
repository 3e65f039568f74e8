"""The answer to a step in the form that is fast to write. `steps.StepResponse` describes it."""

from __future__ import annotations

import msgspec


class Residual(msgspec.Struct, frozen=True):
    translation: float
    rotation: float


class Explanation(msgspec.Struct, frozen=True, omit_defaults=True):
    conjunct: str
    robustness: float | None
    late_by: int | None
    detail: str | None = None


class StepAnswer(msgspec.Struct, frozen=True, kw_only=True):
    """The members in the order in which they are written. `StepResponse` says what they mean."""

    t: int
    mode: str
    distribution: list[float]
    j_values: list[float | None]
    robustness: list[float | None]
    action: int
    action_name: str
    completion_action: int | None
    spec_status: str
    feasible_mass: float | None
    kl: float | None
    reason: str | None
    finished: bool
    next_poses: list[list[float]]
    residual: Residual | None
    in_collision: bool
    witness: list[int] | None
    witnesses: tuple[list[int] | None, ...] | msgspec.UnsetType = msgspec.UNSET
    warnings: tuple[str, ...]
    margin: float
    slack: int
    threshold_left: float
    map_revision: int
    any_signal: bool | msgspec.UnsetType = msgspec.UNSET
    explanations: tuple[Explanation | None, ...] | msgspec.UnsetType = msgspec.UNSET


to_json, to_msgpack = msgspec.json.Encoder().encode, msgspec.msgpack.Encoder().encode
