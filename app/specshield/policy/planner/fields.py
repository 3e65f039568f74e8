"""Fields of steps to go: how far it is from each pose to where a predicate holds.

They are computed on the lattice, by the sweeps of reachability.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Codes, Floats, Int32s
from specshield.compiled import leaf
from specshield.policy.lattice import (
    INVALID,
    NO_TIME,
    STEP_CODES,
    Lattice,
    beside,
    coordinates,
    corner,
    leads_back,
    values_at,
)
from specshield.policy.planner.literals import Literal
from specshield.policy.progress import initial_signals
from specshield.policy.reachability.latest import sweep
from specshield.policy.reachability.sight import BESIDE, about
from specshield.robot.dynamics import Body, displacement, make_body
from specshield.rule.values import places, regions_of
from specshield.stl import SATISFIED_ABOVE
from specshield.stl.program import compile_predicates
from specshield.task import Task

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


def holding(task: Task, lattice: Lattice, literals: tuple[Literal, ...]) -> tuple[Bools, Bools]:
    """Where each literal holds, [L, ny, nx, H], with the signals at their initial values; and the same with
    the poses near to narrow places, which the lattice does not see (reachability/sight.py).
    """
    known, body = places(task), make_body(task.robot, task.grid)
    programs = compile_predicates([each.predicate for each in literals], known)
    values = values_at(body, lattice, regions_of(task), programs, initial_signals(task))
    sides = np.array([each.side for each in literals]).reshape(-1, 1, 1, 1)
    rho, valid, beside = values * sides, lattice.valid == 1, BESIDE * lattice.pitch
    holds: Bools = (rho > SATISFIED_ABOVE) & valid
    missed = [(rho[k] > -beside) & ~about(holds[k]) & valid for k in range(len(literals))]
    return holds, holds | np.array(missed, np.bool_).reshape(holds.shape)


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
    """Steps to go at lattice coordinates: linear in x, y and heading over the corners from which a way leads;
    OUT_OF_REACH where no way leads from any valid corner, inf where no corner is valid.

    A corner without a way does not count beside one that has a way. Where strides are a multiple of the
    pitch and turns are square, no way leads from some of the cells to others, and a robot between two such
    cells can still go as from the better one.
    """
    (ny, nx), code = fields.cell.shape, fields.code[f]
    low, high, share = beside(h, code.shape[1])
    total, weights, valid = 0.0, 0.0, 0.0
    for n in range(4):
        j, i, across = corner(v, u, n)
        if j < 0 or j >= ny or i < 0 or i >= nx or across == 0.0 or fields.cell[j, i] < 0:
            continue
        for heading, part in ((low, 1.0 - share), (high, share)):
            w, found = across * part, code[fields.cell[j, i], heading]
            if w < 1e-9 or found == INVALID:
                continue
            valid += w
            if found < MOST:
                total += w * int(found)
                weights += w
    if weights > 1e-6:
        return total / (STEP_CODES * weights)
    return OUT_OF_REACH if valid > 1e-6 else np.inf


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
    v, u, h = coordinates(body, fields.pitch, headings, x, y, theta)
    grid_theta = theta - math.atan2(body.sin_yaw, body.cos_yaw)
    dv, du = math.sin(grid_theta) / fields.pitch, math.cos(grid_theta) / fields.pitch  # cells a metre ahead
    for m in range(out.shape[0]):
        d, angle = displacement(body, m)
        if leads_back(body, last, m) or (d == 0.0 and angle == 0.0):
            out[m] = np.inf
            continue
        w = h + angle * headings / (2.0 * math.pi)
        out[m] = to_go(fields, f, v + d * dv, u + d * du, w if w >= 0.0 else w + headings)
