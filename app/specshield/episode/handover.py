"""What a session keeps at a switch of rule, map or robot, what it checks of a step beside the shield, and how
its rules and explanations are shown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from specshield.caution.taught import Taught
from specshield.errors import SampleError, StepConflict
from specshield.shield.decision import Carry, Decision
from specshield.task import LARGEST, SIGNAL

E = TypeVar("E")
NEVER = -2  # the step of a decision that precedes no other, so that no pose is compared with what it foresaw


def begun(way: bytes | None) -> Carry | None:
    """The `Carry` with which a session begins. way: its member."""
    return None if way is None else Carry(NEVER, np.empty((0, 3)), (), way=way)


def carried_over(carry: Carry | None, same_map: bool, same_robot: bool, t: int, later: int) -> Carry:
    """The memory that the first decision under a new rule gets from the last one under the old rule. t: the
    step at which the new rule begins, by its own clock, which counts from `later` steps later.

    On the same map, what was learned of it is kept; for the same robot, what is known of its motions. With
    both and the same clock, the pose that the last motion should have reached is kept too. Continuations are
    not: they belong to the old rule.
    """
    carry = Carry(NEVER, np.empty((0, 3)), ()) if carry is None else carry
    stays = same_map and same_robot and later == 0
    return carry._replace(
        t=carry.t if stays else NEVER,
        next_poses=carry.next_poses if stays else np.empty((0, 3)),
        witnesses=(None,) * len(carry.witnesses) if stays else (),
        memory=None,
        residuals=carry.residuals if same_robot else None,
        threshold_left=None,
        learned=_learned(carry.learned, later) if same_map else None,
        action=carry.action if stays else None,
        way=None,
        stuck=carry.stuck if same_map and same_robot else (),
        here=max(carry.here - later, 0) if same_map and same_robot else t,
    )


def check_main_task(over: bool, told: bool) -> None:
    """Raises StepConflict if the main task was over and a step does not say so. told: what the step says."""
    if over and not told:
        said, expected = "an earlier step said that the main task is done, which cannot be taken back", "true"
        raise StepConflict(said, path="main_task_done", got=False, expected=expected)


def check_signals(names: Collection[str], signals: Mapping[str, float]) -> None:
    """Raises SampleError for a signal that none of a session's rules reads, or a value out of range."""
    for name, value in signals.items():
        where = f"signals.{name}"
        if name not in names:
            declared = f"one of {', '.join(sorted(names))}, which the session's rules read"
            expected = declared if names else "no signals: the rule reads none"
            raise SampleError(f"unknown signal {name!r}", path=where, got=name, expected=expected)
        if not -LARGEST <= value <= LARGEST:
            raise SampleError("a signal is out of range", path=where, got=str(value), expected=SIGNAL)


def finite(value: float) -> float | None:
    """The value for JSON: None if it is infinite or NaN."""
    return value if math.isfinite(value) else None


def explained(
    decision: Decision, form: Callable[[str, float | None, int | None, str | None], E]
) -> tuple[E | None, ...]:
    """The explanation of each action, made by `form`; None for an allowed action."""
    return tuple(
        None if why is None else form(why.conjunct, finite(why.robustness), why.late_by, why.detail)
        for why in decision.explanations
    )


def rule_told(about: Mapping[str, Any], begins: int, origin: int, clock: str, status: str) -> dict[str, Any]:
    """A rule of a session as the contract shows it. about: the fields of its policies and of their task."""
    return {
        "from": begins,
        "origin": origin,
        "clock": clock,
        **{name: about[name] for name in ("policy_ids", "map_id")},
        "formula": about["spec"]["formula"],
        **{name: about[name] for name in ("horizon", "actions", "terminal_actions")},
        "spec_status": status,
    }


def _learned(learned: bytes | None, later: int) -> bytes | None:
    """What was learned of the map, with steps by a clock that begins `later` steps later."""
    if not learned or not later:
        return learned
    known = Taught.from_bytes(learned)
    return known._replace(map=replace(known.map, step=known.map.step - later)).to_bytes()
