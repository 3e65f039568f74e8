"""What pi_phi sees: time, pose, the formula's progress, the ways along free space to its goals."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from specshield.compiled import inlined, kernel, leaf
from specshield.robot.dynamics import Body, displacement, longest_motions, motion_count
from specshield.rule.progress import (
    ALWAYS,
    BROKEN,
    EVENTUALLY_ALWAYS,
    PENDING,
    SETTLED,
    STACK,
    Rules,
    read_predicates,
    value_count,
)
from specshield.rule.values import HEADING, REGIONS, fill_pose, fill_region
from specshield.stl.program import VALUE, evaluate_packed
from specshield.task import Task
from specshield.world.geodesic import geodesic_distance

GLOBAL, PER_GOAL, PER_ALWAYS, PER_MOTION = 5, 10, 2, 3
FAR = 2.0  # distances are given in units of 5 m, up to this
NEAR_ALWAYS = 0.3  # [m] an always-predicate farther from its boundary than this is simply safe


class Sight(NamedTuple):
    """What an observation needs of a task, prepared once. G goals: the obligations that are not `always`."""

    distance: NDArray[np.float64]  # [G, height, width] metres along free space to where the predicate holds
    goal: NDArray[np.int64]  # [K] index into `distance`, -1 for an `always`
    centre_x: float
    centre_y: float
    half_x: float
    half_y: float
    horizon: int
    stride: float  # the longest move [m]
    guards: NDArray[np.int64]  # the regions that an `always` reads
    turns_matter: bool  # whether one reads the heading


def make_sight(task: Task, rules: Rules, body: Body) -> Sight:
    """Distances along free space, [height, width] each; cells that an `always` forbids are closed.

    The straight-line distance to a region behind a wall misleads a learner; J and rho never use these.
    """
    grid = task.grid
    predicates = _predicate_maps(rules, grid.centres.reshape(-1, 2)).reshape(-1, grid.height, grid.width)
    free = grid.clearance >= task.robot.radius - 0.5 * grid.resolution
    goals = [k for k in range(len(rules.kind)) if rules.kind[k] != ALWAYS]
    index = np.full(len(rules.kind), -1, dtype=np.int64)
    fields: list[NDArray[np.float64]] = []
    for k in goals:
        index[k] = len(fields)
        allowed = free.copy()
        for j in range(len(rules.kind)):
            if rules.kind[j] == ALWAYS and rules.a[j] == 0 and rules.b[j] >= rules.last[k]:
                allowed &= predicates[j] > rules.margin
        goal = predicates[k] > rules.margin
        reachable = allowed & goal
        fields.append(_fill(geodesic_distance(allowed, reachable, grid.resolution), grid.resolution))
    programs = rules.programs
    owner = np.repeat(rules.kind, np.diff(programs.starts))
    read = set(programs.args[(programs.ops == VALUE) & (owner == ALWAYS)].astype(int).tolist())
    xmin, ymin, xmax, ymax = grid.bounds
    distance = np.stack(fields) if fields else np.zeros((0, grid.height, grid.width))
    return Sight(
        distance=np.ascontiguousarray(distance),
        goal=index,
        centre_x=0.5 * (xmin + xmax),
        centre_y=0.5 * (ymin + ymax),
        half_x=0.5 * (xmax - xmin),
        half_y=0.5 * (ymax - ymin),
        horizon=task.horizon,
        stride=max(longest_motions(body)[0], 0.05),
        guards=np.array([r for r in range(len(task.regions)) if REGIONS + r in read], dtype=np.int64),
        turns_matter=HEADING in read,
    )


def observation_size(rules: Rules, body: Body) -> int:
    always = int(np.sum(rules.kind == ALWAYS))
    goals = len(rules.kind) - always
    return GLOBAL + PER_GOAL * goals + PER_ALWAYS * always + PER_MOTION * motion_count(body)


def _fill(distance: NDArray[np.float64], resolution: float) -> NDArray[np.float64]:
    """Cells no path reaches take the nearest reached cell's distance and the way to it: fields are finite."""
    reached = np.isfinite(distance)
    if not reached.any():
        return np.full_like(distance, 1e3)
    gap, nearest = ndimage.distance_transform_edt(~reached, sampling=resolution, return_indices=True)
    filled: NDArray[np.float64] = distance[tuple(nearest)] + 2.0 * gap
    return filled


@kernel
def _predicate_maps(rules: Rules, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each obligation's predicate at points (N, 2), heading 0. Shape (K, N)."""
    out = np.empty((rules.kind.shape[0], points.shape[0]))
    values, stack, predicates = np.empty(value_count(rules)), np.empty(STACK), np.empty(rules.kind.shape[0])
    for n in range(points.shape[0]):
        read_predicates(rules, points[n, 0], points[n, 1], 0.0, values, stack, predicates)
        out[:, n] = predicates
    return out


@inlined
def _between(body: Body, height: int, width: int, x: float, y: float) -> tuple[int, int, float, float]:
    """The cell centres that a point of the map frame lies between: the lower row and column, how far past."""
    dx, dy = x - body.origin_x, y - body.origin_y
    u = (body.cos_yaw * dx + body.sin_yaw * dy) / body.resolution - 0.5
    v = (body.cos_yaw * dy - body.sin_yaw * dx) / body.resolution - 0.5
    u = min(max(u, 0.0), width - 1.0)
    v = min(max(v, 0.0), height - 1.0)
    i, j = max(min(int(u), width - 2), 0), max(min(int(v), height - 2), 0)
    return j, i, v - j, u - i


@inlined
def _blend(field: NDArray[np.float64], row: int, column: int, up: float, along: float) -> float:
    above, beside = min(row + 1, field.shape[0] - 1), min(column + 1, field.shape[1] - 1)
    low = field[row, column] * (1.0 - along) + field[row, beside] * along
    high = field[above, column] * (1.0 - along) + field[above, beside] * along
    return float(low * (1.0 - up) + high * up)


@inlined
def field_at(body: Body, field: NDArray[np.float64], x: float, y: float) -> float:
    """A field [height, width] of cell centres, bilinear at a point of the map frame, held beyond its edge."""
    row, column, up, along = _between(body, field.shape[0], field.shape[1], x, y)
    return _blend(field, row, column, up, along)


@inlined
def current_goal(rules: Rules, status: NDArray[np.int8]) -> int:
    """The pending goal with the earliest deadline, -1 where none is left."""
    best = -1
    for k in range(rules.kind.shape[0]):
        if (
            rules.kind[k] != ALWAYS
            and status[k] == PENDING
            and (best < 0 or rules.last[k] < rules.last[best])
        ):
            best = k
    return best


@leaf
def outcome(status: NDArray[np.int8]) -> int:
    """BROKEN if any obligation is, SETTLED if all are, else PENDING."""
    settled = True
    for k in range(status.shape[0]):
        if status[k] == BROKEN:
            return BROKEN
        settled = settled and status[k] == SETTLED
    return SETTLED if settled else PENDING


@inlined
def observe(
    body: Body,
    rules: Rules,
    sight: Sight,
    t: int,
    pose: NDArray[np.float64],
    status: NDArray[np.int8],
    run: NDArray[np.int64],
    predicates: NDArray[np.float64],
    nexts: NDArray[np.float64],
    values: NDArray[np.float64],
    stack: NDArray[np.float64],
    after: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Writes the observation at (x_t, t, progress) into `out`, shape (observation_size,).

    predicates (K,) at x_t, nexts (M, 3): the pose after each motion; values, stack, after (K,): scratch, the
    first as `read_predicates` left it at x_t.
    """
    x, y, theta = pose[0], pose[1], pose[2]
    height, width = sight.distance.shape[1], sight.distance.shape[2]
    cos, sin = math.cos(theta), math.sin(theta)
    out[0] = t / sight.horizon
    out[1], out[2] = cos, sin
    out[3], out[4] = (x - sight.centre_x) / sight.half_x, (y - sight.centre_y) / sight.half_y
    at = GLOBAL
    target = current_goal(rules, status)
    here, guarded = 0.0, False
    middle = _between(body, height, width, x, y)
    west, east = _between(body, height, width, x - 0.1, y), _between(body, height, width, x + 0.1, y)
    south, north = _between(body, height, width, x, y - 0.1), _between(body, height, width, x, y + 0.1)
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == ALWAYS:
            guarded = guarded or rules.a[k] <= t + 1 <= rules.b[k]
            out[at] = min(max(predicates[k] / NEAR_ALWAYS, -1.0), 1.0)
            out[at + 1] = 1.0 if rules.a[k] <= t <= rules.b[k] else 0.0
            at += PER_ALWAYS
            continue
        field = sight.distance[sight.goal[k]]
        d = _blend(field, *middle)
        if k == target:
            here = d
        gx = _blend(field, *west) - _blend(field, *east)
        gy = _blend(field, *south) - _blend(field, *north)
        norm = max(math.hypot(gx, gy), 1e-6)
        opens = rules.a[k] + (rules.c2[k] if rules.kind[k] == EVENTUALLY_ALWAYS else 0)
        out[at] = 1.0 if status[k] == SETTLED else 0.0
        out[at + 1] = min(max((opens - t) / 50.0, 0.0), 2.0)
        out[at + 2] = min(max((rules.last[k] - t) / 50.0, -0.2), 2.0)
        out[at + 3] = min(max(predicates[k], -1.0), 1.0)
        out[at + 4] = min(d / 5.0, FAR)
        out[at + 5] = d / (d + 0.5)
        out[at + 6] = (gx * cos + gy * sin) / norm
        out[at + 7] = (gy * cos - gx * sin) / norm
        out[at + 8] = min(max(((rules.last[k] - t) * sight.stride - d) / 5.0, -1.0), 1.0)
        out[at + 9] = run[k] / (rules.b[k] - rules.c2[k] + 1.0) if rules.kind[k] == EVENTUALLY_ALWAYS else 0.0
        at += PER_GOAL
    still = _safety(rules, t + 1, predicates)
    moved, gain, safe, last_x, last_y = 0.0, 0.0, still, x, y
    for m in range(motion_count(body)):
        nx, ny, nth = nexts[m, 0], nexts[m, 1], nexts[m, 2]
        elsewhere = nx != last_x or ny != last_y  # motions that end at one place share what is known of it
        if elsewhere:
            last_x, last_y = nx, ny
            moved, gain, safe = math.hypot(nx - x, ny - y), 0.0, still
            if target >= 0 and moved > 0.0:
                ahead = here - field_at(body, sight.distance[sight.goal[target]], nx, ny)
                gain = min(max(ahead / sight.stride, -1.5), 1.5)
        if guarded and (elsewhere or sight.turns_matter):
            safe = _safety_at(rules, sight, t + 1, nx, ny, nth, values, stack, after)
        move, turn = displacement(body, m)
        full = moved >= abs(move) - 1e-6 and (turn == 0.0 or nth != theta)
        out[at] = 1.0 if full else 0.0
        out[at + 1] = gain
        out[at + 2] = safe
        at += PER_MOTION


@inlined
def _safety(rules: Rules, t: int, predicates: NDArray[np.float64]) -> np.float32:
    """How far every `always` that holds at step t is from being broken, of NEAR_ALWAYS; in [-1, 1]."""
    safe = np.float32(1.0)
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == ALWAYS and rules.a[k] <= t <= rules.b[k]:
            safe = min(safe, np.float32(max(predicates[k] / NEAR_ALWAYS, -1.0)))
    return safe


@inlined
def _safety_at(
    rules: Rules,
    sight: Sight,
    t: int,
    x: float,
    y: float,
    theta: float,
    values: NDArray[np.float64],
    stack: NDArray[np.float64],
    predicates: NDArray[np.float64],
) -> np.float32:
    """_safety at a pose; values, stack, predicates (K,): scratch."""
    fill_pose(x, y, theta, values)
    for r in sight.guards:
        fill_region(rules.regions, r, x, y, values)
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == ALWAYS:
            predicates[k] = evaluate_packed(k, rules.programs, values, stack)
    return _safety(rules, t, predicates)
