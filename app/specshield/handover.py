"""What a session takes along when another rule, map or robot holds from some step on, and how it is told."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from specshield.errors import StepConflict
from specshield.shield.decision import Carry, Decision
from specshield.shield.taught import Taught

E = TypeVar("E")
NEVER = -2  # the step of a decision that no other follows: nothing is compared with what it foresaw


def begun(way: bytes | None) -> Carry | None:
    """What the first decision of a session is given. way: see `Carry`."""
    return None if way is None else Carry(NEVER, np.empty((0, 3)), (), way=way)


def carried_over(carry: Carry | None, same_map: bool, same_robot: bool, t: int, later: int) -> Carry:
    """What the last decision under the old rule hands to the first one under the new, whose windows count
    from `later` steps later. t: the step at which the new rule begins, by its own clock.

    What the map has learned stays where the map is the same, what is known of the robot where the robot is;
    where both are and the clock goes on, so does what the last motion should have led to. Continuations are
    of the old rule.
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
    """over: whether the main task is; told: whether a step says so. Raises StepConflict where that is taken
    back.
    """
    if over and not told:
        said, expected = "an earlier step said that the main task is done, which cannot be taken back", "true"
        raise StepConflict(said, path="main_task_done", got=False, expected=expected)


def finite(value: float) -> float | None:
    """As it is told in JSON: None for what has no number there."""
    return value if math.isfinite(value) else None


def explained(
    decision: Decision, form: Callable[[str, float | None, int | None, str | None], E]
) -> tuple[E | None, ...]:
    """What is said of each action, in the form of an answer's; None for one that is allowed."""
    return tuple(
        None if why is None else form(why.conjunct, finite(why.robustness), why.late_by, why.detail)
        for why in decision.explanations
    )


def rule_told(about: Mapping[str, Any], begins: int, origin: int, clock: str, status: str) -> dict[str, Any]:
    """A rule of a session as the contract shows it. about: its policies, and the task that they are for."""
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
    """What the map has learned, by a clock that begins so many steps later."""
    if not learned or not later:
        return learned
    known = Taught.from_bytes(learned)
    return known._replace(map=replace(known.map, step=known.map.step - later)).to_bytes()
