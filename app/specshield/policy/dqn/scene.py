"""A task as the compiled functions of the DQN take it, with the distances along free space to its goals.

The straight-line distance to a region behind a wall misleads a learner, so observations and the default
reward use the distance along free space. J and rho never do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from specshield.arrays import Floats, Int8s, Ints
from specshield.compiled import inlined, kernel
from specshield.policy.geodesic import geodesic_distance
from specshield.policy.progress import (
    ALWAYS,
    PENDING,
    Rules,
    goals_of,
    make_rules,
    read_predicates,
    value_count,
)
from specshield.robot.body import in_grid
from specshield.robot.dynamics import Body, longest_motions, make_body
from specshield.rule.values import HEADING, REGIONS
from specshield.stl.program import STACK_SIZE, VALUE
from specshield.task import Task

# The networks that are shipped were trained with these, which were chosen by hand; nothing was measured.
UNREACHABLE = 1e3  # [m] the distance everywhere to a goal that no cell of the map reaches
OFF_THE_WAY = 2.0  # metres of distance for each metre to the nearest cell that reaches the goal
SHORTEST_STRIDE = 0.05  # [m] so that a robot that only turns divides by something


class Scene(NamedTuple):
    """Map, robot and rule of a task. A goal is an obligation that is not an `always`; there are G of them."""

    body: Body
    rules: Rules
    distance: Floats  # [G, height, width] metres along free space to where the goal's predicate holds
    goal: Ints  # [K] index into `distance`, -1 for an `always`
    centre: tuple[float, float]  # of the map [m]
    half: tuple[float, float]  # half the map's width and height [m]
    horizon: int
    stride: float  # the longest move [m]
    guards: Ints  # the regions that an `always` reads
    guards_turn: bool  # whether an `always` reads the heading
    wait: int  # the motion that leaves the pose as it is, -1 for a robot that has none


def make_scene(task: Task) -> Scene:
    """Prepares a task once. Raises FragmentError as `obligations` does."""
    grid, body, rules = task.grid, make_body(task.robot, task.grid), make_rules(task)
    poses = np.insert(grid.centres.reshape(-1, 2), 2, 0.0, axis=1)
    holds = predicates_at(rules, poses).reshape(grid.height, grid.width, -1) > rules.margin
    free = grid.clearance >= task.robot.radius - 0.5 * grid.resolution
    goals = goals_of(rules)
    index = np.full(len(rules.kind), -1, dtype=np.int64)
    index[goals] = np.arange(len(goals))
    distance = np.zeros((len(goals), grid.height, grid.width))
    for k in goals:  # the cells that an `always` forbids as long as the goal is due are closed
        lasting = (rules.kind == ALWAYS) & (rules.a == 0) & (rules.b >= rules.last[k])
        allowed = free & holds[..., lasting].all(axis=-1)
        reached = geodesic_distance(allowed, allowed & holds[..., k], grid.resolution)
        distance[index[k]] = _filled(reached, grid.resolution)
    programs = rules.programs
    owner = np.repeat(rules.kind, np.diff(programs.starts))
    read = set(programs.args[(programs.ops == VALUE) & (owner == ALWAYS)].astype(int).tolist())
    xmin, ymin, xmax, ymax = grid.bounds
    return Scene(
        body=body,
        rules=rules,
        distance=distance,
        goal=index,
        centre=(0.5 * (xmin + xmax), 0.5 * (ymin + ymax)),
        half=(0.5 * (xmax - xmin), 0.5 * (ymax - ymin)),
        horizon=task.horizon,
        stride=max(longest_motions(body)[0], SHORTEST_STRIDE),
        guards=np.array([r for r in range(len(task.areas)) if REGIONS + r in read], dtype=np.int64),
        guards_turn=HEADING in read or bool(np.any(rules.regions.carried[:, :2] != 0.0)),
        wait=task.robot.wait_motion,
    )


def _filled(distance: Floats, resolution: float) -> Floats:
    """The field made finite: a cell that no way reaches counts as a detour by the nearest one reached."""
    reached = np.isfinite(distance)
    if reached.all() or not reached.any():
        return np.where(reached, distance, UNREACHABLE)
    gap, nearest = scipy.ndimage.distance_transform_edt(~reached, sampling=resolution, return_indices=True)
    filled: Floats = distance[tuple(nearest)] + OFF_THE_WAY * gap
    return filled


@kernel
def predicates_at(rules: Rules, poses: Floats) -> Floats:
    """The robustness of each obligation's predicate at each of poses (N, 3). Shape (N, K)."""
    out = np.empty((poses.shape[0], rules.kind.shape[0]))
    values, stack = np.empty(value_count(rules)), np.empty(STACK_SIZE)
    for n in range(poses.shape[0]):
        read_predicates(rules, poses[n, 0], poses[n, 1], poses[n, 2], values, stack, out[n])
    return out


@inlined
def between(scene: Scene, x: float, y: float) -> tuple[int, int, float, float]:
    """The cell centres around a point of the map frame: lower row and column, and the shares of the way on.

    Points beyond the outermost centres count as lying on the edge of the map.
    """
    body, height, width = scene.body, scene.distance.shape[1], scene.distance.shape[2]
    u, v = in_grid(body, x, y)
    u = min(max(u / body.resolution - 0.5, 0.0), width - 1.0)
    v = min(max(v / body.resolution - 0.5, 0.0), height - 1.0)
    i, j = max(min(int(u), width - 2), 0), max(min(int(v), height - 2), 0)
    return j, i, v - j, u - i


@inlined
def blend(field: Floats, row: int, column: int, up: float, along: float) -> float:
    """The bilinear value of a field [height, width] at a place that `between` found."""
    above, beside = min(row + 1, field.shape[0] - 1), min(column + 1, field.shape[1] - 1)
    low = field[row, column] * (1.0 - along) + field[row, beside] * along
    high = field[above, column] * (1.0 - along) + field[above, beside] * along
    return float(low * (1.0 - up) + high * up)


@inlined
def distance_to(scene: Scene, k: int, x: float, y: float) -> float:
    """Metres along free space from a point of the map frame to where goal k's predicate holds."""
    row, column, up, along = between(scene, x, y)
    return blend(scene.distance[scene.goal[k]], row, column, up, along)


@inlined
def current_goal(rules: Rules, status: Int8s) -> int:
    """The pending goal with the earliest deadline, the first of those due together, -1 where none is left."""
    best = -1
    for k in range(rules.kind.shape[0]):
        pending = rules.kind[k] != ALWAYS and status[k] == PENDING
        if pending and (best < 0 or rules.last[k] < rules.last[best]):
            best = k
    return best
