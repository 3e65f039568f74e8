"""The lattice that look-ahead is solved on, and the formula's windows as it counts them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel
from specshield.errors import Unsupported
from specshield.lookahead.surrogate import is_blocked
from specshield.policy.lattice import heading_count, pose_of
from specshield.policy.reachability.tables import Tables, slack
from specshield.robot.dynamics import Body, in_collision, longest_motions, motion_count, step
from specshield.rule.progress import (
    ALWAYS,
    EVENTUALLY_ALWAYS,
    PENDING,
    SETTLED,
    STACK,
    Rules,
    read_predicates,
    value_count,
)

PITCH = 0.4  # [m]: as fine as the stand-ins deserve
MAX_HEADINGS = 24
MAX_ENTRIES = 40_000_000  # poses times steps and sets of settled goals
KEPT = 500_000  # of them, in a table of D


class Planes(NamedTuple):
    """The lattice and the formula's windows. Poses [H, N]: a padded plane of cells for each heading.

    pad, width: of a plane, in cells. free [M, H, N]: 1 where a motion is not stopped short. holds, keeps [H,
    N]: bit g where goal g's, bit k where obligation k's predicate is true. goal [G]: the obligations that are
    goals; first, last [G]: the steps at which a visit settles them (of a dwell, its beginning). due, open [T
    + 2]: bits of the always that hold at a step, of the goals that can be settled. slot [T + 2, 2^G]: numbers
    each step and set of settled goals that can be had, -1 for others. kept [T + 2, 2^G]: where a table of D
    has them, a few steps sharing what holds at the last of them; row [N]: where it has a cell, -1 where no
    pose is free. possible [slots, H, N]: 1 where the rule can still be kept, as a policy's tables say; of no
    slots where there are none to say so.
    """

    pitch: float
    pad: int
    width: int
    valid: NDArray[np.uint8]
    free: NDArray[np.float32]
    holds: NDArray[np.int32]
    keeps: NDArray[np.int32]
    goal: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    due: NDArray[np.int32]
    open: NDArray[np.int32]
    slot: NDArray[np.int64]
    kept: NDArray[np.int64]
    row: NDArray[np.int64]
    possible: NDArray[np.uint8]


def make_planes(
    body: Body, rules: Rules, horizon: int, tables: Tables | None = None, pitch: float = PITCH
) -> Planes:
    """Raises Unsupported where the tables would be too large."""
    longest, largest = longest_motions(body)
    headings = min(heading_count([largest] if largest else []), MAX_HEADINGS)
    rows, columns = (math.ceil(n * body.resolution / pitch - 1e-9) for n in body.occupied.shape)
    pad = math.ceil(longest / pitch - 1e-9) + 1
    width, cells = columns + 2 * pad, (rows + 2 * pad) * (columns + 2 * pad)
    goal = np.flatnonzero(rules.kind != ALWAYS)
    dwell = rules.kind[goal] == EVENTUALLY_ALWAYS
    first = rules.a[goal] + np.where(dwell, rules.c2[goal], 0)
    last = np.where(dwell, rules.c1[goal] + rules.c2[goal], rules.b[goal])
    slot = _slots(first, last, horizon, 1)
    if (slot.max() + 1) * headings * cells > MAX_ENTRIES:
        raise Unsupported(
            "the task is too large for look-ahead", path="shaping",
            got=f"{slot.max() + 1} times {headings} x {cells} poses",
            expected=f"at most {MAX_ENTRIES} entries; or shaping 'projection'",
        )  # fmt: skip
    times = np.arange(horizon + 2)
    steady = np.flatnonzero(rules.kind == ALWAYS)
    due = sum((((rules.a[k] <= times) & (times <= rules.b[k])) << k for k in steady), np.zeros_like(times))
    opened = sum(
        (((first[g] <= times) & (times <= last[g])) << g for g in range(len(goal))), np.zeros_like(times)
    )
    shape = (headings, cells)
    planes = Planes(
        pitch, pad, width, np.zeros(shape, np.uint8), np.zeros((motion_count(body), *shape), np.float32),
        np.zeros(shape, np.int32), np.zeros(shape, np.int32), goal, first, last,
        due.astype(np.int32), opened.astype(np.int32), slot, slot, np.full(cells, -1),
        np.zeros((0, *shape), np.uint8),
    )  # fmt: skip
    _survey(body, rules, planes)
    rooms = planes.valid.any(axis=0)
    planes.row[rooms] = np.arange(rooms.sum())
    kept = (slot.max() + 1) * headings * max(int(rooms.sum()), 1)
    planes = planes._replace(kept=_slots(first, last, horizon, math.ceil(kept / KEPT)))
    if tables is None:
        return planes
    possible = np.zeros((planes.slot.max() + 1, *shape), np.uint8)
    _foresee(body, rules, tables, planes, possible)
    return planes._replace(possible=possible)


def _slots(first: NDArray[np.int64], last: NDArray[np.int64], horizon: int, every: int) -> NDArray[np.int64]:
    """The sets of settled goals that can be had at each step, numbered; `every` steps share a number.

    But for the first of a set: what comes before a window opens is paid there.
    """
    settled = np.arange(1 << len(first))[:, None] >> np.arange(len(first)) & 1 == 1
    slot, n = np.full((horizon + 2, len(settled)), -1), 0
    for t in range(horizon + 1):
        for mask in np.flatnonzero(np.all(np.where(settled, first <= t, last > t), axis=1)):
            slot[t, mask] = slot[t - 1, mask] if t % every and slot[t - 2, mask] >= 0 else n
            n = max(n, slot[t, mask] + 1)
    return slot


@kernel
def _survey(body: Body, rules: Rules, planes: Planes) -> None:
    """Where poses are free, which motions are, and which predicates hold."""
    headings, cells = planes.valid.shape
    values, stack, read = np.empty(value_count(rules)), np.empty(STACK), np.empty(rules.kind.shape[0])
    after = np.empty(3)
    for h in range(headings):
        for c in range(cells):
            j, i = c // planes.width - planes.pad, c % planes.width - planes.pad
            x, y, theta = pose_of(body, planes.pitch, headings, j, i, h)
            if in_collision(body, x, y, theta):
                continue
            planes.valid[h, c] = 1
            read_predicates(rules, x, y, theta, values, stack, read)
            for g in range(planes.goal.shape[0]):
                planes.holds[h, c] |= np.int32(read[planes.goal[g]] > rules.margin) << g
            for k in range(read.shape[0]):
                planes.keeps[h, c] |= np.int32(read[k] > rules.margin) << k
            for m in range(planes.free.shape[0]):
                after[0], after[1], after[2] = step(body, x, y, theta, m)
                planes.free[m, h, c] = not is_blocked(body, m, x, y, theta, after)


@kernel
def _foresee(body: Body, rules: Rules, tables: Tables, planes: Planes, possible: NDArray[np.uint8]) -> None:
    """Where the tables leave any slack, with each set of settled goals at each step."""
    headings, cells = planes.valid.shape
    status, run = np.zeros(rules.kind.shape[0], np.int8), np.zeros(rules.kind.shape[0], np.int64)
    for t in range(planes.slot.shape[0] - 1):
        for mask in range(planes.slot.shape[1]):
            slot = planes.slot[t, mask]
            if slot < 0:
                continue
            for g in range(planes.goal.shape[0]):
                status[planes.goal[g]] = SETTLED if mask >> g & 1 else PENDING
            for h in range(headings):
                for c in range(cells):
                    if planes.valid[h, c]:
                        j, i = c // planes.width - planes.pad, c % planes.width - planes.pad
                        x, y, theta = pose_of(body, planes.pitch, headings, j, i, h)
                        spare = slack(body, rules, tables, x, y, theta, t, status, run)
                        possible[slot, h, c] = spare >= 0.0
