"""The lattice that tables are computed on: poses at the crossings of x, y and heading, where f leads from
each of them, and what a table says between them.

f leaves the lattice at once (turns of 6 degrees, moves of 0.2 m, contact), so values off it are interpolated.
What a table says is therefore only a suggestion: the exact simulation certifies.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.arrays import Bools, Bytes, Floats, Int32s, Ints, Singles
from specshield.compiled import inlined, kernel, leaf
from specshield.policy.progress import Rules, fill_place, fill_signals
from specshield.robot.body import in_grid
from specshield.robot.dynamics import (
    TOUCH,
    Body,
    displacement,
    displacements,
    free_distance,
    in_collision,
    longest_motions,
    step_from,
    swing_radius,
)
from specshield.rule.values import HEADING, REGIONS
from specshield.stl.program import STACK_SIZE, VALUE, Programs, evaluate_packed
from specshield.task import Task
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import PackedRegions, turns_with_robot

STEP_CODES = 64.0  # codes of a step in a table of steps
INVALID = 65535  # the code of a pose that is in collision or breaks what the table keeps
NO_TIME = -1.0  # in place of a step, where there is none
Pose = tuple[float, float, float]
SMALL = 1_000_000  # poses of a lattice that one thread makes
THREADS = 2  # that make a larger one: kernels let go of the interpreter's lock
# [m] A move that contact cuts shorter than this, or than half of its stride if that is less, leads nowhere.
SHORTEST_MOVE = 0.02  # chosen by hand
MAX_HEADINGS = 120
FEWEST_HEADINGS, USUAL_HEADINGS = 24, 72  # where none fits every turn exactly: 15 to 5 degrees each
# [headings] How far a turn may be off a multiple of a heading to count as exact, and as nearly exact: ten
# turns that are off by NEAR_HEADING make half a heading. Chosen by hand.
SAME_HEADING, NEAR_HEADING = 1e-3, 0.05


def heading_count(rotations: list[float]) -> int:
    """The fewest headings, 4 to MAX_HEADINGS, of which every rotation [rad] is exactly a multiple.

    If there are none, the fewest from FEWEST_HEADINGS on of which every rotation is nearly a multiple, else
    USUAL_HEADINGS.
    """

    def error(n: int) -> float:
        steps = np.array(rotations) * n / (2.0 * math.pi)
        return float(np.abs(steps - np.round(steps)).max(initial=0.0))

    for n in range(4, MAX_HEADINGS + 1):
        if error(n) < SAME_HEADING:
            return n
    odd = range(FEWEST_HEADINGS, USUAL_HEADINGS + 1)
    return next((n for n in odd if error(n) < NEAR_HEADING), USUAL_HEADINGS)


def headings_of(task: Task) -> int:
    """The headings of a task's lattice."""
    return heading_count([turn for _, turn in task.robot.motions if turn != 0.0])


def side_of(grid: OccupancyGrid | Body, pitch: float) -> tuple[int, int]:
    """Rows and columns of a lattice on a map."""
    ny, nx = (max(math.ceil(n * grid.resolution / pitch - 1e-9), 1) for n in grid.occupied.shape)
    return ny, nx


class Lattice(NamedTuple):
    """Poses [ny, nx, H] in the grid frame, spaced `pitch` [m] and 2 pi / H.

    valid: the footprint is free. far_u, far_v [ny, nx, H, D]: where each of the D moving motions leads, in
    lattice coordinates, -1 where it leads nowhere else; far_h: the heading it ends in, rounded. turns
    [ny, nx, H, R]: whether each of the R turns on the spot is possible; shift [R]: by how many headings.
    reach: the longest move, in cells, rounded up.
    """

    pitch: float
    headings: int
    valid: Bytes
    far_u: Singles
    far_v: Singles
    far_h: NDArray[np.int16]
    turns: Bytes
    shift: Ints
    reach: int


def number_cells(used: Bools) -> Int32s:
    """The row that each cell in use has in a table, -1 for the others. used, result [ny, nx]."""
    cell = np.full(used.shape, -1, np.int32)
    cell[used] = np.arange(int(used.sum()))
    return cell


def make_lattice(body: Body, pitch: float, cells: Bools | None = None) -> Lattice:
    """Simulates every motion from every pose of the lattice once, or of those `cells` [ny, nx] alone: the
    other poses count as not valid.
    """
    ny, nx = side_of(body, pitch)
    moves, rotations = displacements(body)
    headings = heading_count([float(r) for r in rotations if r != 0.0])
    moving = np.flatnonzero(moves != 0.0)
    turning = np.flatnonzero((moves == 0.0) & (rotations != 0.0))
    shape = (ny, nx, headings)
    lattice = Lattice(
        pitch=pitch,
        headings=headings,
        valid=np.zeros(shape, np.uint8),
        far_u=np.full((*shape, len(moving)), -1.0, np.float32),
        far_v=np.full((*shape, len(moving)), -1.0, np.float32),
        far_h=np.zeros((*shape, len(moving)), np.int16),
        turns=np.zeros((*shape, len(turning)), np.uint8),
        shift=np.array([round(rotations[m] * headings / (2.0 * math.pi)) for m in turning], np.int64),
        reach=math.ceil(longest_motions(body)[0] / pitch) + 1,
    )
    if cells is None:
        cells = np.ones((ny, nx), np.bool_)
    parts = THREADS if ny * nx * headings > SMALL else 1
    rows = np.linspace(0, ny, 4 * parts + 1).astype(int).tolist()

    def simulate(part: int) -> None:
        _simulate_all(body, lattice, moving, turning, cells, rows[part], rows[part + 1])

    with ThreadPoolExecutor(parts) as pool:
        list(pool.map(simulate, range(4 * parts)))
    return lattice


@leaf
def pose_of(
    body: Body, pitch: float, headings: int, j: float, i: float, h: float
) -> tuple[float, float, float]:
    """The map-frame pose at lattice coordinates; whole numbers are crossings."""
    u, v = (i + 0.5) * pitch, (j + 0.5) * pitch
    x = body.origin_x + u * body.cos_yaw - v * body.sin_yaw
    y = body.origin_y + u * body.sin_yaw + v * body.cos_yaw
    theta = h * 2.0 * math.pi / headings
    return x, y, theta if theta <= math.pi else theta - 2.0 * math.pi


@inlined
def coordinates(
    body: Body, pitch: float, headings: int, x: float, y: float, theta: float
) -> tuple[float, float, float]:
    """Lattice coordinates (v, u, heading in [0, H)) of a pose of the map frame."""
    u, v = in_grid(body, x, y)
    h = theta * headings / (2.0 * math.pi)
    return v / pitch - 0.5, u / pitch - 0.5, h if h >= 0.0 else h + headings


@inlined
def corner(v: float, u: float, n: int) -> tuple[int, int, float]:
    """Row and column of the nth (0 to 3) of the crossings about a place (v, u), and its bilinear weight."""
    j, i = int(np.floor(v)), int(np.floor(u))
    q, p = v - j, u - i
    wj, wi = q if n >> 1 else 1.0 - q, p if n & 1 else 1.0 - p
    return j + (n >> 1), i + (n & 1), wj * wi


class Corners(NamedTuple):
    """The crossings about a place that some table knows: rows of the table (4,), bilinear weights (4,)."""

    row: Ints
    weight: Floats


@inlined
def find_corners(cell: Int32s, v: float, u: float, corners: Corners) -> int:
    """Writes the crossings about a place; returns how many there are. cell [ny, nx]: the row of each in the
    table, -1 for none.
    """
    ny, nx = cell.shape
    found = 0
    for n in range(4):
        j, i, across = corner(v, u, n)
        if j < 0 or j >= ny or i < 0 or i >= nx or across == 0.0 or cell[j, i] < 0:
            continue
        corners.row[found], corners.weight[found] = cell[j, i], across
        found += 1
    return found


@inlined
def beside(h: float, headings: int) -> tuple[int, int, float]:
    """The headings of a lattice on both sides of h, and the share of the way from the one to the other."""
    k = int(np.floor(h))
    low = k if 0 <= k < headings else k % headings  # nearly always the former, and a division takes long
    return low, low + 1 if low + 1 < headings else 0, h - k


@leaf
def bilinear(valid: Bytes, table: Singles, v: float, u: float, h: int) -> float:
    """A table [ny, nx, H] at a place and one heading, over the corners whose pose is valid; NO_TIME where
    none is.
    """
    ny, nx = table.shape[0], table.shape[1]
    total, weights = 0.0, 0.0
    for n in range(4):
        j, i, w = corner(v, u, n)
        if j < 0 or j >= ny or i < 0 or i >= nx or w == 0.0 or not valid[j, i, h]:
            continue
        total += w * table[j, i, h]
        weights += w
    return total / weights if weights > 1e-6 else NO_TIME


@inlined
def leads_on(body: Body, motion: int, x: float, y: float, theta: float, to: Pose) -> bool:
    """Whether a motion from a pose, which has led to `to`, leads anywhere."""
    far, _ = displacement(body, motion)
    return bool(abs(to[0] - x) + abs(to[1] - y) > min(SHORTEST_MOVE, 0.5 * abs(far)) or to[2] != theta)


@inlined
def leads_back(body: Body, last: int, motion: int) -> bool:
    """Whether a motion goes or turns the other way than the one before; `last` is -1 for none."""
    if last < 0:
        return False
    before, turn = displacement(body, last)
    d, angle = displacement(body, motion)
    return bool(d * before < 0.0 or angle * turn < 0.0)


@kernel
def _simulate_all(
    body: Body, lattice: Lattice, moving: Ints, turning: Ints, cells: Bools, first: int, stop: int
) -> None:
    """Rows `first` to stop - 1."""
    _, nx, headings = lattice.valid.shape
    offset = swing_radius(body) - body.radius
    farthest = body.radius + longest_motions(body)[0] + 3.0 * offset + 2.0 * TOUCH  # that any motion reaches
    for j in range(first, stop):
        for i in range(nx):
            if not cells[j, i]:
                continue
            u, v = (i + 0.5) * lattice.pitch, (j + 0.5) * lattice.pitch
            room = free_distance(body, u, v, farthest) - offset  # around the footprint's centre, at least
            for h in range(headings):
                x, y, theta = pose_of(body, lattice.pitch, headings, j, i, h)
                if room < body.radius + TOUCH and in_collision(body, x, y, theta):
                    continue
                lattice.valid[j, i, h] = 1
                cos, sin = math.cos(theta), math.sin(theta)
                for d in range(moving.shape[0]):
                    x1, y1, theta1 = step_from(body, x, y, theta, cos, sin, room, moving[d])
                    if x1 != x or y1 != y or theta1 != theta:
                        v, u, w = coordinates(body, lattice.pitch, headings, x1, y1, theta1)
                        lattice.far_u[j, i, h, d], lattice.far_v[j, i, h, d] = u, v
                        lattice.far_h[j, i, h, d] = round(w) % headings
                for r in range(turning.shape[0]):
                    _, _, theta1 = step_from(body, x, y, theta, cos, sin, room, turning[r])
                    lattice.turns[j, i, h, r] = theta1 != theta


@kernel
def values_at(
    body: Body, lattice: Lattice, regions: PackedRegions, programs: Programs, signals: Floats
) -> Singles:
    """Each predicate's robustness over the lattice, [P, ny, nx, H]; -inf where the pose is not valid.

    The programs read x, y, theta, the regions, then `signals` (S,).
    """
    ny, nx, headings = lattice.valid.shape
    count = programs.starts.shape[0] - 1
    out = np.full((count, ny, nx, headings), -np.inf, np.float32)
    values = np.empty(REGIONS + regions.plain.shape[0] + signals.shape[0])
    stack, read = np.empty(STACK_SIZE), np.empty(count)
    turns_matter = reads_heading(programs, regions)
    fill_signals(regions, signals, values)
    for j in range(ny):
        for i in range(nx):
            fresh = True
            for h in range(headings):
                if not lattice.valid[j, i, h]:
                    continue
                if fresh or turns_matter:
                    x, y, theta = pose_of(body, lattice.pitch, headings, j, i, h)
                    fill_place(regions, x, y, theta, values)
                    for p in range(count):
                        read[p] = evaluate_packed(p, programs, values, stack)
                    fresh = False
                for p in range(count):
                    out[p, j, i, h] = read[p]
    return out


def holds_at(body: Body, rules: Rules, lattice: Lattice) -> Bytes:
    """Where each obligation's predicate holds, [K, ny, nx, H]; 0 where the pose is not valid."""
    values = values_at(body, lattice, rules.regions, rules.programs, rules.signals)
    return (values > rules.margin).astype(np.uint8)


@leaf
def reads_heading(programs: Programs, regions: PackedRegions) -> bool:
    """Whether some predicate may depend on where the robot looks, and not only on where it is."""
    reads = False
    for i in range(programs.ops.shape[0]):
        reads = reads or (programs.ops[i] == VALUE and programs.args[i] == HEADING)
    for r in range(regions.plain.shape[0]):
        reads = reads or turns_with_robot(regions, r)
    return reads
