"""The lattice that look-ahead is solved on, and the formula's windows as it counts them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Bytes, Int32s, Ints, Singles
from specshield.caution.surprise.barred import NOTHING_BARRED
from specshield.compiled import inlined, kernel, leaf
from specshield.errors import Unsupported
from specshield.policy.lattice import coordinates, find_corners, heading_count, pose_of
from specshield.policy.progress import (
    ALWAYS,
    EVENTUALLY_ALWAYS,
    PENDING,
    SETTLED,
    Rules,
    goals_of,
    read_predicates,
    value_count,
)
from specshield.policy.reachability.guide import make_scratch
from specshield.policy.reachability.tables import Guide, Tables, slack_at
from specshield.robot.dynamics import Body, displacement, in_collision, longest_motions, motion_count, step
from specshield.stl.program import STACK_SIZE

COARSE_PITCH = 0.4  # [m] as fine as the stand-ins deserve; chosen by hand, nothing measured
MOST_HEADINGS = 24  # one for each 15 degrees; chosen by hand, nothing measured
MAX_ENTRIES = 40_000_000  # poses times steps and sets of settled goals: what solving one stand-in costs
KEPT_ENTRIES = 500_000  # of them that a table of D keeps, 1 MB


Pose = tuple[float, float, float]


class Planes(NamedTuple):
    """The lattice for a robot on its map, and the formula's windows. Poses [H, N]: a padded plane of cells
    for each heading.

    The lattice. pitch [m]; pad, width: of a plane, in cells. valid [H, N]: 1 where a pose is free; free [M,
    H, N]: 1 where a motion is not stopped short; row [N]: the place of a cell in a table of D, -1 where no
    pose is free.

    The formula. holds, keeps [H, N]: bit g is set where the predicate of goal g holds, bit k where that of
    obligation k does. goal [G]: the obligations that are goals; first, last [G]: the steps between which a
    visit settles them (of a dwell, the visit's beginning). due, open [T + 2]: bits of the `always` that have
    to hold at a step, and of the goals that can be settled at it.

    The sets of settled goals at each step. slot [T + 2, 2^G]: numbers those that can be had, -1 for the
    others. kept [T + 2, 2^G]: their places in a table of D; a few steps share the place of the last of them.
    possible [slots, H, N]: 1 where the tables of a policy say that the rule can still be kept; it has no
    slots where there are no tables.
    """

    body: Body
    pitch: float
    pad: int
    width: int
    valid: Bytes
    free: Singles
    holds: Int32s
    keeps: Int32s
    goal: Ints
    first: Ints
    last: Ints
    due: Int32s
    open: Int32s
    slot: Ints
    kept: Ints
    row: Ints
    possible: Bytes


def make_planes(
    body: Body, rules: Rules, horizon: int, tables: Tables | None = None, pitch: float = COARSE_PITCH
) -> Planes:
    """Raises Unsupported where the tables would be too large."""
    longest, largest = longest_motions(body)
    headings = min(heading_count([largest] if largest else []), MOST_HEADINGS)
    rows, columns = (math.ceil(n * body.resolution / pitch - 1e-9) for n in body.occupied.shape)
    pad = math.ceil(longest / pitch - 1e-9) + 1
    width, cells = columns + 2 * pad, (rows + 2 * pad) * (columns + 2 * pad)
    goal = goals_of(rules)
    first = rules.a[goal] + rules.c2[goal]
    last = np.where(rules.kind[goal] == EVENTUALLY_ALWAYS, rules.c1[goal] + rules.c2[goal], rules.b[goal])
    slot = _slots(first, last, horizon, 1)
    slots, shape = slot.max() + 1, (headings, cells)
    if slots * headings * cells > MAX_ENTRIES:
        raise Unsupported(
            "the task is too large for look-ahead",
            path="shaping",
            got=f"{slots} steps and sets of settled goals times {headings} x {cells} poses",
            expected=f"at most {MAX_ENTRIES} in all; or shaping 'projection'",
        )
    steady = np.flatnonzero(rules.kind == ALWAYS)
    due = _bits(rules.a[steady], rules.b[steady], steady, horizon)
    opened = _bits(first, last, np.arange(len(goal)), horizon)
    planes = Planes(
        body,
        pitch,
        pad,
        width,
        np.zeros(shape, np.uint8),
        np.zeros((motion_count(body), *shape), np.float32),
        np.zeros(shape, np.int32),
        np.zeros(shape, np.int32),
        goal,
        first,
        last,
        due,
        opened,
        slot,
        slot,
        np.full(cells, -1),
        np.zeros((0, *shape), np.uint8),
    )
    _survey(rules, planes)
    rooms = planes.valid.any(axis=0)
    planes.row[rooms] = np.arange(rooms.sum())
    entries = slots * headings * max(int(rooms.sum()), 1)
    planes = planes._replace(kept=_slots(first, last, horizon, math.ceil(entries / KEPT_ENTRIES)))
    if tables is None:
        return planes
    planes = planes._replace(possible=np.zeros((slots, *shape), np.uint8))
    _rule_out(Guide(body, rules, tables, -1, NOTHING_BARRED), planes)
    return planes


def _bits(first: Ints, last: Ints, bit: Ints, horizon: int) -> Int32s:
    """The bits of the windows from `first` to `last` that each step from 0 to T + 1 is in, [T + 2]."""
    times = np.arange(horizon + 2)[:, None]
    inside = ((first <= times) & (times <= last)).astype(np.int32)
    return inside @ (1 << bit).astype(np.int32)


def _slots(first: Ints, last: Ints, horizon: int, every: int) -> Ints:
    """Numbers the sets of settled goals that can be had at each step, [T + 2, 2^G]; `every` steps share a
    number. The first step of a set has one of its own, since what comes before a window opens is paid there.
    """
    settled = np.arange(1 << len(first))[:, None] >> np.arange(len(first)) & 1 == 1
    slot, n = np.full((horizon + 2, len(settled)), -1), 0
    for t in range(horizon + 1):
        for mask in np.flatnonzero(np.all(np.where(settled, first <= t, last > t), axis=1)):
            slot[t, mask] = slot[t - 1, mask] if t % every and slot[t - 2, mask] >= 0 else n
            n = max(n, slot[t, mask] + 1)
    return slot


@inlined
def pose_at(planes: Planes, h: int, c: int) -> Pose:
    """The map-frame pose of cell c of the plane of heading h."""
    j, i = c // planes.width - planes.pad, c % planes.width - planes.pad
    return pose_of(planes.body, planes.pitch, planes.valid.shape[0], j, i, h)


@leaf
def is_blocked(body: Body, motion: int, pose: Pose, after: Pose) -> bool:
    """Whether f stopped the motion from a pose short; after: where it led."""
    moved = math.hypot(after[0] - pose[0], after[1] - pose[1])
    move, rotation = displacement(body, motion)
    return moved < 0.5 * abs(move) or not (rotation == 0.0 or after[2] != pose[2])


@kernel
def blocked_at(body: Body, x: float, y: float, theta: float) -> Bools:
    """Which motions an obstacle stops short at a pose, shape (M,)."""
    blocked = np.empty(motion_count(body), np.bool_)
    for m in range(len(blocked)):
        blocked[m] = is_blocked(body, m, (x, y, theta), step(body, x, y, theta, m))
    return blocked


@kernel
def _survey(rules: Rules, planes: Planes) -> None:
    """Where poses are free, which motions are, and which predicates hold."""
    headings, cells = planes.valid.shape
    values, stack, read = np.empty(value_count(rules)), np.empty(STACK_SIZE), np.empty(rules.kind.shape[0])
    for h in range(headings):
        for c in range(cells):
            x, y, theta = pose_at(planes, h, c)
            if in_collision(planes.body, x, y, theta):
                continue
            planes.valid[h, c] = 1
            read_predicates(rules, x, y, theta, values, stack, read)
            for g in range(planes.goal.shape[0]):
                planes.holds[h, c] |= np.int32(read[planes.goal[g]] > rules.margin) << g
            for k in range(read.shape[0]):
                planes.keeps[h, c] |= np.int32(read[k] > rules.margin) << k
            planes.free[:, h, c] = ~blocked_at(planes.body, x, y, theta)


@kernel
def _rule_out(guide: Guide, planes: Planes) -> None:
    """Leaves `possible` 0 where the tables leave no slack, for each set of settled goals at each step."""
    (headings, cells), tables = planes.valid.shape, guide.tables
    scratch = make_scratch(guide.rules, 1)
    scratch.status[:], scratch.run[:] = PENDING, 0
    for t in range(planes.slot.shape[0] - 1):
        for mask in range(planes.slot.shape[1]):
            slot = planes.slot[t, mask]
            if slot < 0:
                continue
            for g in range(planes.goal.shape[0]):
                scratch.status[planes.goal[g]] = SETTLED if mask >> g & 1 else PENDING
            for c in range(cells):
                if planes.row[c] < 0:
                    continue
                v, u, _ = coordinates(guide.body, tables.pitch, headings, *pose_at(planes, 0, c))
                known = find_corners(tables.cell, v, u, scratch.corners)  # the same for each heading
                for h in range(headings):
                    if planes.valid[h, c]:
                        x, y, theta = pose_at(planes, h, c)
                        left = slack_at(guide, x, y, theta, t, scratch, scratch.corners, known)
                        planes.possible[slot, h, c] = left >= 0.0
