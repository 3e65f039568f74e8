"""The lattice that reachability is computed on: poses at the crossings of x, y and heading, and where f
leads from each.

f leaves the lattice at once (6 degree headings, 0.2 m moves, contact), so values off it are interpolated,
and what the
tables say is a proposal: only exact simulation certifies.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import inlined, kernel, leaf
from specshield.robot.dynamics import (
    TOUCH,
    Body,
    displacements,
    free_distance,
    in_collision,
    longest_motions,
    step,
    swing_radius,
    unhindered,
)
from specshield.rule.progress import STACK, Rules, read_predicates, value_count
from specshield.rule.values import HEADING
from specshield.stl.program import VALUE

MAX_HEADINGS = 120


class Lattice(NamedTuple):
    """Poses [ny, nx, H] in the grid frame, spaced `pitch` [m] and 2 pi / H.

    valid: the footprint is free. far_u, far_v [ny, nx, H, D]: where each of the D translating motions leads,
    in cells of the lattice (-1: nowhere else); far_h: with which heading. turns [ny, nx, H, R]: whether each
    turn is possible; shift [R]: by how many headings. reach: the longest move, in cells, rounded up.
    """

    pitch: float
    headings: int
    valid: NDArray[np.uint8]
    far_u: NDArray[np.float32]
    far_v: NDArray[np.float32]
    far_h: NDArray[np.int16]
    turns: NDArray[np.uint8]
    shift: NDArray[np.int64]
    reach: int


def heading_count(rotations: list[float]) -> int:
    """The fewest headings that every rotation is a multiple of; at least 4, at most MAX_HEADINGS."""
    for n in range(4, MAX_HEADINGS + 1):
        unit = 2.0 * math.pi / n
        if all(abs(r / unit - round(r / unit)) < 1e-6 for r in rotations):
            return n
    return 72


def make_lattice(body: Body, pitch: float) -> Lattice:
    """Simulates every motion from every pose of the lattice once."""
    height, width = body.occupied.shape
    ny, nx = (max(math.ceil(n * body.resolution / pitch - 1e-9), 1) for n in (height, width))
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
    _simulate_all(body, lattice, moving, turning)
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
    dx, dy = x - body.origin_x, y - body.origin_y
    u = (body.cos_yaw * dx + body.sin_yaw * dy) / pitch - 0.5
    v = (body.cos_yaw * dy - body.sin_yaw * dx) / pitch - 0.5
    h = theta * headings / (2.0 * math.pi)
    return v, u, h if h >= 0.0 else h + headings


@kernel
def _simulate_all(
    body: Body, lattice: Lattice, moving: NDArray[np.int64], turning: NDArray[np.int64]
) -> None:
    ny, nx, headings = lattice.valid.shape
    turns_within = swing_radius(body) + TOUCH
    moves_within = turns_within + longest_motions(body)[0]
    for j in range(ny):
        for i in range(nx):
            u, v = (i + 0.5) * lattice.pitch, (j + 0.5) * lattice.pitch
            room = free_distance(body, u, v, moves_within)
            for h in range(headings):
                x, y, theta = pose_of(body, lattice.pitch, headings, j, i, h)
                if room < turns_within and in_collision(body, x, y, theta):
                    continue
                lattice.valid[j, i, h] = 1
                cos, sin = math.cos(theta), math.sin(theta)
                for d in range(moving.shape[0]):
                    if room >= moves_within:
                        x1, y1, theta1 = unhindered(body, x, y, theta, cos, sin, moving[d])
                    else:
                        x1, y1, theta1 = step(body, x, y, theta, moving[d])
                    if x1 != x or y1 != y or theta1 != theta:
                        v, u, w = coordinates(body, lattice.pitch, headings, x1, y1, theta1)
                        lattice.far_u[j, i, h, d], lattice.far_v[j, i, h, d] = u, v
                        lattice.far_h[j, i, h, d] = round(w) % headings
                for r in range(turning.shape[0]):
                    if room >= turns_within:
                        _, _, theta1 = unhindered(body, x, y, theta, cos, sin, turning[r])
                    else:
                        _, _, theta1 = step(body, x, y, theta, turning[r])
                    lattice.turns[j, i, h, r] = theta1 != theta


@kernel
def holds_at(body: Body, rules: Rules, lattice: Lattice) -> NDArray[np.uint8]:
    """Where each obligation's predicate holds, [K, ny, nx, H]; 0 where the pose is not valid."""
    ny, nx, headings = lattice.valid.shape
    out = np.zeros((rules.kind.shape[0], ny, nx, headings), np.uint8)
    values, stack, predicates = np.empty(value_count(rules)), np.empty(STACK), np.empty(rules.kind.shape[0])
    turns_matter = np.any((rules.programs.ops == VALUE) & (rules.programs.args == HEADING))
    for j in range(ny):
        for i in range(nx):
            fresh = True
            for h in range(headings):
                if not lattice.valid[j, i, h]:
                    continue
                if fresh or turns_matter:
                    x, y, theta = pose_of(body, lattice.pitch, headings, j, i, h)
                    read_predicates(rules, x, y, theta, values, stack, predicates)
                    fresh = False
                for k in range(predicates.shape[0]):
                    out[k, j, i, h] = predicates[k] > rules.margin
    return out
