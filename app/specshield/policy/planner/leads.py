"""The fields of a policy, and which of them leads to which literal of its rule."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from specshield.arrays import Codes, Int32s, Ints
from specshield.policy.lattice import INVALID, STEP_CODES, make_lattice, number_cells
from specshield.policy.planner.due_dates import foresee, is_open_if, make_bounds
from specshield.policy.planner.fields import Fields, holding, steps_to
from specshield.policy.planner.literals import LAST, PackedLiterals, literals_of
from specshield.robot.dynamics import make_body
from specshield.stl import Always, Eventually, Implies, Not, Or, conjuncts
from specshield.task import Task

MAX_ENTRIES = 50_000_000  # of all fields: 100 MB
MAX_FIELDS = 32  # further literals have no field, so no plan goes to where they hold
NEAREST = 1.0  # [steps] more than the fewest to an answer still count as the fewest; chosen by hand


def make_fields(
    task: Task, pitch: float, on_progress: Callable[[float], None] = lambda done: None
) -> tuple[Fields, Int32s]:
    """The fields, on a lattice with cells of `pitch` [m], and `chosen` (see `PlannerPolicy`).

    on_progress: told the share that is done.
    """
    packed, literals = literals_of(task, task.formula)
    lattice = make_lattice(make_body(task.robot, task.grid), pitch)
    (holds, near), free = holding(task, lattice, literals), lattice.valid == 1
    used = free.any(axis=2)
    codes: dict[tuple[int, tuple[int, ...]], Codes] = {}
    chosen = np.full((len(literals), 2), -1, np.int32)
    lasting = _lasting(task, packed)
    for column in (0, 1):
        for k in range(len(literals)):
            others = [g for g in range(len(literals)) if literals[g].predicate != literals[k].predicate]
            kept = lasting >= packed.literal[k, LAST]  # as long as the goal may be asked for
            keeps = tuple(g for g in others if kept[g] or (column == 1 and literals[g].guards))
            if (k, keeps) not in codes and len(codes) < MAX_FIELDS:
                allowed = free.copy()
                for g in keeps:  # the left of an `until` need not hold where the right does
                    ended = (literals[k].predicate, literals[k].side) in literals[g].ends
                    allowed &= holds[g] | near[k] if ended else holds[g]
                codes[k, keeps] = steps_to(lattice, near[k], allowed)[used]
            chosen[k, column] = list(codes).index((k, keeps)) if (k, keeps) in codes else chosen[k, 0]
            on_progress((column * len(literals) + k + 1) / (2 * len(literals)))
    made, prompt = list(codes.values()), chosen.copy()
    index = {each[:2]: k for k, each in enumerate(literals)}
    most = min(MAX_FIELDS, MAX_ENTRIES // (int(used.sum()) * free.shape[2] or 1))
    for part in conjuncts(task.formula):
        match part:
            case Always(_, _, Implies(p, Eventually(_, _, q)) | Or((Not(p), Eventually(_, _, q)))):
                k, answer = (index.get((each, 1), -1) for each in (p, q))
                if min(k, answer) >= 0 and prompt[k, 0] == chosen[k, 0] and len(made) < most:
                    own, left = (made[f] for f in chosen[[k, answer], 0])
                    goal, keeps = np.zeros((2, *free.shape), np.bool_)
                    keeps[used] = own != INVALID
                    here = near[k][used] & keeps[used]
                    goal[used] = here & (left <= left[here].min(initial=INVALID) + NEAREST * STEP_CODES)
                    prompt[k] = len(made)
                    allowed = keeps & (goal | ~near[k])  # the response begins at the way's end, not before
                    made.append(steps_to(lattice, goal, allowed)[used])
    chosen = np.hstack([chosen, prompt]) if len(made) > len(codes) else chosen
    cell = number_cells(used)
    code = np.array(made, np.uint16).reshape(len(made), int(used.sum()), free.shape[2])
    return Fields(cell, code, pitch), chosen


def _lasting(task: Task, packed: PackedLiterals) -> Ints:
    """The step up to which each literal has to hold at every step from 1 on, whatever else happens; 0 if it
    need not hold at step 1. Shape [L].
    """
    tree = packed.formula.tree
    bounds = make_bounds(tree.size)
    foresee(packed, -1, np.empty(tree.size), np.zeros(len(packed.leaf)), bounds)
    for n in np.flatnonzero(packed.leaf[:, 0] < 0):  # the signals may be anything
        span = slice(tree.leaf_at[n], tree.leaf_at[n] + tree.leaf_stop[n] - tree.leaf_start[n])
        bounds.low[span], bounds.high[span] = -np.inf, np.inf
    lasting = np.zeros(len(packed.literal), np.int64)
    for k in range(len(lasting)):
        for t in range(1, task.horizon + 1):
            if is_open_if(packed, k, -1, -1, t, t, bounds):
                break
            lasting[k] = t
    return lasting
