"""Fields of steps to go: how far it is from each pose to where a predicate holds.

They are computed on the lattice, by the sweeps of reachability.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Codes, Floats, Int32s, Singles
from specshield.compiled import kernel, leaf
from specshield.policy.lattice import (
    INVALID,
    NO_TIME,
    STEP_CODES,
    Lattice,
    coordinates,
    coordinates_ahead,
    heading_after,
    interpolate,
    leads_back,
    pose_of,
)
from specshield.policy.reachability.latest import sweep
from specshield.robot.dynamics import Body, displacement
from specshield.rule.values import REGIONS, fill_place, fill_pose, fill_signals, region_count
from specshield.stl.program import STACK_SIZE, Programs, evaluate_packed
from specshield.world.regions import PackedRegions

OUT_OF_REACH = 1000.0  # [steps] what is farther counts as out of reach
MOST = int(STEP_CODES * OUT_OF_REACH)  # the code of OUT_OF_REACH
UNREACHED = 65534  # the code of what no way leads from; read as MOST


class Fields(NamedTuple):
    """Steps to go, stored over the cells that have a free pose.

    cell [ny, nx]: row of `code`, -1 where no pose is free. code [F, cells, H]: STEP_CODES * steps to go,
    UNREACHED, or INVALID for a pose that is in collision or breaks what the field keeps.
    """

    cell: Int32s
    code: Codes
    pitch: float


@kernel
def values_at(
    body: Body, lattice: Lattice, areas: PackedRegions, programs: Programs, signals: Floats
) -> Singles:
    """Each predicate's robustness over the lattice, [P, ny, nx, H]; -inf where the pose is not valid.

    The programs read x, y, theta, the regions, then `signals` (S,).
    """
    ny, nx, headings = lattice.valid.shape
    count = programs.starts.shape[0] - 1
    out = np.full((count, ny, nx, headings), -np.inf, np.float32)
    values = np.empty(REGIONS + region_count(areas) + signals.shape[0])
    turns_matter = np.any(areas.carried[:, :2] != 0.0)
    stack = np.empty(STACK_SIZE)
    fill_signals(areas, signals, values)
    for j in range(ny):
        for i in range(nx):
            fresh = True
            for h in range(headings):
                if not lattice.valid[j, i, h]:
                    continue
                x, y, theta = pose_of(body, lattice.pitch, headings, j, i, h)
                if fresh or turns_matter:  # most areas do not turn with the robot
                    fill_place(areas, x, y, theta, values)
                    fresh = False
                fill_pose(x, y, theta, values)
                for p in range(count):
                    out[p, j, i, h] = evaluate_packed(p, programs, values, stack)
    return out


def steps_to(lattice: Lattice, goal: Bools, keeps: Bools) -> Codes:
    """The field of one goal as codes [ny, nx, H], over the free poses that `keeps` allows."""
    valid = np.ascontiguousarray(lattice.valid & keeps)
    latest = np.where(goal & (valid == 1), np.float32(OUT_OF_REACH), np.float32(NO_TIME))
    sweep(lattice, valid, 0.0, latest)
    code = np.where(latest >= 0.0, np.ceil(STEP_CODES * (OUT_OF_REACH - latest)), UNREACHED).astype(np.uint16)
    code[valid == 0] = INVALID
    return code


@leaf
def to_go(fields: Fields, f: int, v: float, u: float, h: float) -> float:
    """Steps to go at lattice coordinates; inf where no corner is valid."""
    return interpolate(fields.cell, fields.code[f], 0.0, MOST, np.inf, v, u, h)


@leaf
def to_go_at(body: Body, fields: Fields, f: int, x: float, y: float, theta: float) -> float:
    """Steps to go from a pose of the map frame."""
    v, u, h = coordinates(body, fields.pitch, fields.code.shape[2], x, y, theta)
    return to_go(fields, f, v, u, h)


@leaf
def to_go_after(
    body: Body, fields: Fields, f: int, x: float, y: float, theta: float, last: int, out: Floats
) -> None:
    """Steps to go after each motion (M,), contact left out; inf for what leads straight back after `last`."""
    headings = fields.code.shape[2]
    v, u, h, dv, du = coordinates_ahead(body, fields.pitch, headings, x, y, theta)
    for m in range(out.shape[0]):
        d, angle = displacement(body, m)
        if leads_back(body, last, m) or (d == 0.0 and angle == 0.0):
            out[m] = np.inf
            continue
        out[m] = to_go(fields, f, v + d * dv, u + d * du, heading_after(headings, h, angle))
