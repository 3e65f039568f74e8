"""The gate that every answer passes: what is claimed of the actions, and what of it is certified.

Which futures are tried, and how much margin and slack is asked of them, is found outside the trusted core
(caution/). What is found there is a claim: these motions are feasible, and these futures show it. Here a
claim counts only if its future was simulated by the shield on the session's map, begins with the motion and
keeps the rule. So a mistake outside the core can make the shield too strict, but never unsound.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Bytes, Floats, Ints
from specshield.compiled import kernel
from specshield.robot.dynamics import Body
from specshield.shield.decision import Shield
from specshield.shield.feasibility import Futures, Prefix, best_of, rho_of
from specshield.stl import SATISFIED_ABOVE

Witnesses = tuple[bytes | None, ...]


class Claim(NamedTuple):
    """What is claimed of M motions and A actions at one step.

    motions [M]: which are feasible. row [M]: the future in `tried` that shows it, -1 where there is none.
    values [A]: J if real-valued, -inf where nothing was evaluated. robustness [A]: likewise, rho of the whole
    formula. completion: the action to execute if the model's task is over. lowered: whether J asked for less
    margin or slack than the session's settings say.
    """

    tried: Futures
    motions: Bools
    row: Ints
    values: Floats
    robustness: Floats
    completion: int
    lowered: bool


class Certified(NamedTuple):
    """What holds of a claim.

    feasible [A]: S_t; false for a terminal action. witnesses: each motion's certified continuation, one
    motion a byte; None for a motion that is not certified. warnings: those of the futures, and one if a claim
    did not hold. The other fields are as in `Claim`.
    """

    feasible: Bools
    witnesses: Witnesses
    values: Floats
    robustness: Floats
    completion: int
    lowered: bool
    warnings: tuple[str, ...]

    @property
    def some(self) -> bool:
        """Whether some action is feasible."""
        return True in self.feasible.tolist()


def certify(shield: Shield, body: Body, prefix: Prefix, claim: Claim) -> Certified:
    """The part of a claim that holds: for the robot on the session's map, and the formula of the prefix."""
    robot, tried, completion, values = shield.task.robot, claim.tried, claim.completion, claim.values
    rho, warnings = tried.rho, tried.warnings
    if tried.prefix is not prefix:  # a future that was given up has no poses to judge
        rho = np.where(rho > -np.inf, rho_of(prefix, tried.poses)[0], -np.inf)
    claimed = claim.motions if tried.body is body else np.zeros_like(claim.motions)
    holds, feasible, rows = _hold(tried.motions, rho, claimed, claim.row, robot.motion_of)
    held, content, n = holds.tolist(), rows.tobytes(), rows.shape[1]
    if held != claim.motions.tolist():
        warnings = (*warnings, "not every action that seemed feasible has a future that keeps the rule")
    if shield.config.evaluation == "robustness":
        best = best_of(tried.motions, rho, len(held)).robustness
        values = np.minimum(values, np.where(robot.motion_of >= 0, best[robot.motion_of], -np.inf))
    motion = robot.motion_of[completion]
    if True in held and (motion < 0 or not held[motion]):
        shown = np.where(holds, rho.take(claim.row, mode="clip"), -np.inf)
        completion = int(robot.representative[np.argmax(shown)])
    witnesses = tuple([content[m * n : m * n + n] if ok else None for m, ok in enumerate(held)])
    return Certified(feasible, witnesses, values, claim.robustness, completion, claim.lowered, warnings)


@kernel
def _hold(
    motions: Ints, rho: Floats, claimed: Bools, row: Ints, motion_of: Ints
) -> tuple[Bools, Bools, Bytes]:
    """Which of the claimed motions (M,) have a future that keeps the rule; the actions (A,) that make such a
    motion; and what follows these motions in their futures (M, T - t - 1).

    motions (N, T - t), rho (N,): of the futures; row (M,): which of them shall show it. motion_of (A,): -1
    for a terminal action.
    """
    count, n = claimed.shape[0], motions.shape[1] - 1
    holds, feasible = np.zeros(count, np.bool_), np.zeros(motion_of.shape[0], np.bool_)
    rows = np.empty((count, n), np.uint8)
    for m in range(count):
        f = row[m]
        if claimed[m] and 0 <= f < rho.shape[0] and motions[f, 0] == m and rho[f] > SATISFIED_ABOVE:
            holds[m] = True
            for k in range(n):
                rows[m, k] = motions[f, k + 1]
    for a in range(feasible.shape[0]):
        feasible[a] = motion_of[a] >= 0 and holds[motion_of[a]]
    return holds, feasible, rows


def as_actions(shield: Shield, witnesses: Witnesses, action: int) -> tuple[int, ...] | None:
    """The certified continuation of an action, as action indices."""
    motion = int(shield.task.robot.motion_of[action])
    found = witnesses[motion] if motion >= 0 else None
    return None if found is None else tuple(found.translate(shield.task.robot.action_table))


def j_values_of(shield: Shield, certified: Certified) -> tuple[float | None, ...]:
    """J of each action [A]; a terminal one has the highest of the others (docs/architecture.md)."""
    binary = shield.config.evaluation == "feasibility"
    values = certified.feasible.astype(np.float64) if binary else certified.values
    return as_numbers(np.where(shield.task.robot.terminal, values.max(), values).tolist())


def as_numbers(values: list[float]) -> tuple[float | None, ...]:
    """The values with None in place of -inf, where nothing was evaluated."""
    return tuple([None if value == -math.inf else value for value in values])
