"""The tables of latest feasible times as decisions read them: the slack of a pose, and where it grows."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import inlined, leaf
from specshield.policy.lattice import coordinates
from specshield.policy.progress import ALWAYS, BROKEN, EVENTUALLY_ALWAYS, PENDING, SETTLED, Rules
from specshield.robot.unicycle import Body

SCALE = 64.0  # table codes a step
INVALID = 65535  # code of a pose that is in collision or breaks an `always` of the phase
HOPELESS = -1e9
SAFE = 1e6


class Tables(NamedTuple):
    """Latest feasible times, stored over the cells that have a valid pose.

    cell [ny, nx]: row of `code`, -1 where no pose is valid. code [P, cells, H]: INVALID, 0 for never, else
    1 + SCALE * L. table [phases, 2^G]: which table a set of settled goals has in a phase, -1 if it has none.
    phase [T + 1]: of each step; end [phases]: its last step. bit [K]: the obligation's bit in a set of
    settled
    goals, 0 for an `always`.
    """

    cell: NDArray[np.int32]
    code: NDArray[np.uint16]
    table: NDArray[np.int32]
    phase: NDArray[np.int32]
    end: NDArray[np.int32]
    bit: NDArray[np.int64]
    pitch: float


@inlined
def latest_at(tables: Tables, table: int, v: float, u: float, h: float) -> float:
    """L at lattice coordinates: linear in x, y and heading over the corners that are valid; HOPELESS where
    none is.
    """
    ny, nx = tables.cell.shape
    headings = tables.code.shape[2]
    j, i, k = int(np.floor(v)), int(np.floor(u)), int(np.floor(h))
    q, p, f = v - j, u - i, h - k
    low, high = k % headings, (k + 1) % headings
    total, weights = 0.0, 0.0
    for dj in range(2):
        wj = q if dj else 1.0 - q
        if j + dj < 0 or j + dj >= ny or wj == 0.0:
            continue
        for di in range(2):
            wi = wj * (p if di else 1.0 - p)
            if i + di < 0 or i + di >= nx or wi == 0.0:
                continue
            row = tables.cell[j + dj, i + di]
            if row < 0:
                continue
            w = wi * (1.0 - f)
            code = tables.code[table, row, low]
            if w >= 1e-9 and code != INVALID:
                total += w * (code - 1.0)
                weights += w
            w = wi * f
            code = tables.code[table, row, high]
            if w >= 1e-9 and code != INVALID:
                total += w * (code - 1.0)
                weights += w
    return total / (SCALE * weights) if weights > 1e-6 else HOPELESS


@leaf
def slack(
    body: Body,
    rules: Rules,
    tables: Tables,
    x: float,
    y: float,
    theta: float,
    t: int,
    status: NDArray[np.int8],
    run: NDArray[np.int64],
) -> float:
    """Steps to spare at (x_t, progress): L - t. SAFE once every goal is settled, HOPELESS where something
    is broken.
    """
    mask, every = 0, 0
    for k in range(status.shape[0]):
        if status[k] == BROKEN:
            return HOPELESS
        every |= tables.bit[k]
        if status[k] == SETTLED:
            mask |= tables.bit[k]
    if mask == every and tables.phase[t] == len(tables.end) - 1:
        return SAFE
    v, u, h = coordinates(body, tables.pitch, tables.code.shape[2], x, y, theta)
    best = HOPELESS
    table = tables.table[tables.phase[t], mask]
    if table >= 0:
        best = latest_at(tables, table, v, u, h) - t
    for k in range(status.shape[0]):  # a dwell under way: what is left of it, then the rest
        if rules.kind[k] == EVENTUALLY_ALWAYS and status[k] == PENDING and run[k] > 0:
            over = t + rules.b[k] - rules.c2[k] + 1 - run[k]
            if over < tables.phase.shape[0]:
                best = max(best, _after_dwell(tables, mask | tables.bit[k], every, over, v, u, h))
    return best


@inlined
def _after_dwell(tables: Tables, mask: int, every: int, t: int, v: float, u: float, h: float) -> float:
    """The slack once a dwell is over, at step t and where it was begun."""
    if mask == every and tables.phase[t] == len(tables.end) - 1:
        return float(tables.end[-1] - t)
    table = tables.table[tables.phase[t], mask]
    return latest_at(tables, table, v, u, h) - t if table >= 0 else HOPELESS


@inlined
def goals_settled(rules: Rules, status: NDArray[np.int8]) -> bool:
    for k in range(status.shape[0]):
        if status[k] == BROKEN or (rules.kind[k] != ALWAYS and status[k] == PENDING):
            return False
    return True


@inlined
def is_broken(status: NDArray[np.int8]) -> bool:
    broken = False
    for k in range(status.shape[0]):
        broken = broken or status[k] == BROKEN
    return broken


@inlined
def score(
    body: Body,
    rules: Rules,
    tables: Tables,
    x: float,
    y: float,
    theta: float,
    t: int,
    status: NDArray[np.int8],
    run: NDArray[np.int64],
    wait: int,
    last: int,
    scores: NDArray[np.float64],
) -> None:
    """L after each motion (M,) from x_t, contact and the step's own progress left out: a cheap order to try
    motions in.

    last: the motion before, -1 for none. HOPELESS for what leads straight back: the tables err by a little.
    """
    mask, every = 0, 0
    for k in range(status.shape[0]):
        every |= tables.bit[k]
        if status[k] == SETTLED:
            mask |= tables.bit[k]
    if mask == every and tables.phase[t + 1] == len(tables.end) - 1:
        scores[:] = SAFE
        return
    table = tables.table[tables.phase[t + 1], mask]
    headings = tables.code.shape[2]
    v, u, h = coordinates(body, tables.pitch, headings, x, y, theta)
    grid_theta = theta - math.atan2(body.sin_yaw, body.cos_yaw)
    cos, sin = math.cos(grid_theta) / tables.pitch, math.sin(grid_theta) / tables.pitch
    before, turn = (body.translate[last], body.rotate[last]) if last >= 0 else (0.0, 0.0)
    for m in range(scores.shape[0]):
        d = body.translate[m]
        if table < 0 or d * before < 0.0 or body.rotate[m] * turn < 0.0:
            scores[m] = HOPELESS
            continue
        w = h + body.rotate[m] * headings / (2.0 * math.pi)
        if w < 0.0:
            w += headings
        scores[m] = latest_at(tables, table, v + d * sin, u + d * cos, w)
    for k in range(status.shape[0]):
        if rules.kind[k] == EVENTUALLY_ALWAYS and status[k] == PENDING and run[k] > 0:
            over = t + rules.b[k] - rules.c2[k] + 1 - run[k]
            if over < tables.phase.shape[0]:
                spare = _after_dwell(tables, mask | tables.bit[k], every, over, v, u, h)
                scores[wait] = max(scores[wait], spare + t + 1.0)
