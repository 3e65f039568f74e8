"""The tables as decisions read them: the slack of a pose, and where it grows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bytes, Codes, Floats, Int8s, Int32s, Ints
from specshield.compiled import inlined, leaf
from specshield.policy.lattice import (
    Corners,
    coordinates,
    coordinates_ahead,
    corner,
    find_corners,
    heading_after,
    leads_back,
    read_corners,
)
from specshield.policy.progress import ALWAYS, BROKEN, EVENTUALLY_ALWAYS, PENDING, SETTLED, Rules
from specshield.robot.dynamics import Body, displacement

HOPELESS = -1e9  # in place of a slack or a latest time [steps], where nothing is feasible
SAFE = 1e6  # in place of a slack [steps], where nothing is left to do
UNKNOWN = -1  # in place of how many corners there are about a place
DELAYS = (0, 1, 2, 4, 8)  # [steps] that a robot which cannot wait would like to have to spare


class Tables(NamedTuple):
    """Latest feasible times (latest.py), or feasibility step by step (stepwise.py), over the cells that have
    a valid pose.

    cell [ny, nx]: row of `code`, -1 where no pose is valid. code [P, cells, H]: INVALID, 0 for never, else
    1 + STEP_CODES * L. table [phases, 2^G]: which one a set of settled goals has in a phase, -1 for none.
    phase [T + 1]: of each step; end [phases]: its last step. bit [K]: the obligation's bit in a set of
    settled goals, 0 for an `always`. bits [T + 1, cells, H, bytes], stride, dwell [K]: step by step; bits has
    no steps where the tables are latest times. early [steps]: how much earlier deadlines are to be met than
    those that the tables, of latest times, were made for.
    """

    cell: Int32s
    code: Codes
    table: Int32s
    phase: Int32s
    end: Int32s
    bit: Ints
    bits: Bytes
    stride: Ints
    dwell: Ints
    pitch: float
    early: int


@inlined
def latest_at(tables: Tables, table: int, corners: Corners, count: int, h: float) -> float:
    """L at the first `count` of the corners about a place, HOPELESS where none is valid."""
    return read_corners(corners, count, tables.code[table], HOPELESS, h)


@leaf
def slack(
    body: Body, rules: Rules, tables: Tables, x: float, y: float, theta: float, t: int, status: Int8s,
    run: Ints, corners: Corners,
) -> float:  # fmt: skip
    """Steps to spare at (x_t, progress): L - t - early. SAFE once every goal is settled, HOPELESS where
    something is broken. corners: scratch.
    """
    return slack_at(body, rules, tables, x, y, theta, t, status, run, corners, UNKNOWN)


@inlined
def slack_at(
    body: Body, rules: Rules, tables: Tables, x: float, y: float, theta: float, t: int, status: Int8s,
    run: Ints, corners: Corners, count: int,
) -> float:  # fmt: skip
    """`slack`, inlined. corners: those about (x, y) where `count` says how many, else scratch."""
    if tables.bits.shape[0] > 0:
        return _steps_ahead(body, rules, tables, x, y, theta, t, status, run)
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
    if count == UNKNOWN:
        count = find_corners(tables.cell, v, u, corners)
    best = HOPELESS
    table = tables.table[tables.phase[t], mask]
    if table >= 0:
        best = latest_at(tables, table, corners, count, h) - (t + tables.early)
    for k in range(status.shape[0]):  # a dwell under way: what is left of it, then the rest
        if rules.kind[k] == EVENTUALLY_ALWAYS and status[k] == PENDING and run[k] > 0:
            over = t + rules.b[k] - rules.c2[k] + 1 - run[k]
            if over < tables.phase.shape[0]:
                best = max(best, _after_dwell(tables, mask | tables.bit[k], every, over, corners, count, h))
    return best


@leaf
def _steps_ahead(
    body: Body, rules: Rules, tables: Tables, x: float, y: float, theta: float, t: int, status: Int8s,
    run: Ints,
) -> float:  # fmt: skip
    """How feasible a pose is, step by step: from 0 to 1 now, and as much for each of some delays [steps]
    that it would stand. SAFE once nothing is pending, HOPELESS where it is not feasible at all.
    """
    progress, pending = 0, False
    for k in range(status.shape[0]):
        if status[k] == BROKEN:
            return HOPELESS
        pending = pending or status[k] == PENDING
        if rules.kind[k] != ALWAYS:
            digit = min(run[k], tables.dwell[k]) if status[k] == PENDING else tables.dwell[k] + 1
            progress += tables.stride[k] * digit
    if not pending:
        return SAFE
    v, u, h = coordinates(body, tables.pitch, tables.code.shape[2], x, y, theta)
    ahead = 0.0
    for delay in DELAYS:
        if t + delay >= tables.bits.shape[0]:
            break
        ahead += _feasible_at(tables, t + delay, progress, v, u, h)
        if ahead == 0.0:
            return HOPELESS
    return ahead


@leaf
def _feasible_at(tables: Tables, t: int, progress: int, v: float, u: float, h: float) -> float:
    """The share of the lattice's corners, by weight, from which the formula can be satisfied at step t."""
    (ny, nx), headings, k = tables.cell.shape, tables.bits.shape[2], int(np.floor(h))
    share = 0.0
    for n in range(4):
        j, i, w = corner(v, u, n)
        if j < 0 or j >= ny or i < 0 or i >= nx or tables.cell[j, i] < 0:
            continue
        for up in range(2):
            bits = tables.bits[t, tables.cell[j, i], (k + up) % headings, progress >> 3]
            if bits >> (progress & 7) & 1:
                share += w * (h - k if up else 1.0 - h + k)
    return share


@inlined
def _after_dwell(
    tables: Tables, mask: int, every: int, t: int, corners: Corners, count: int, h: float
) -> float:
    """The slack once a dwell is over, at step t and where it was begun."""
    if mask == every and tables.phase[t] == len(tables.end) - 1:
        return float(tables.end[-1] - (t + tables.early))
    table = tables.table[tables.phase[t], mask]
    return latest_at(tables, table, corners, count, h) - (t + tables.early) if table >= 0 else HOPELESS


@inlined
def goals_settled(rules: Rules, status: Int8s) -> bool:
    for k in range(status.shape[0]):
        if status[k] == BROKEN or (rules.kind[k] != ALWAYS and status[k] == PENDING):
            return False
    return True


@inlined
def is_broken(status: Int8s) -> bool:
    broken = False
    for k in range(status.shape[0]):
        broken = broken or status[k] == BROKEN
    return broken


@inlined
def score(
    body: Body, rules: Rules, tables: Tables, x: float, y: float, theta: float, t: int, status: Int8s,
    run: Ints, wait: int, last: int, scores: Floats, corners: Corners, ahead: Corners,
) -> int:  # fmt: skip
    """L after each motion (M,) from x_t, contact and the step's own progress left out: a cheap order to try
    motions in.

    last: the motion before, -1 for none. HOPELESS for what leads straight back: the tables err by a little.
    Writes the corners about (x, y) and returns how many there are, UNKNOWN where they were not needed; ahead:
    scratch.
    """
    if tables.bits.shape[0] > 0:
        scores[:] = SAFE
        return UNKNOWN
    mask, every = 0, 0
    for k in range(status.shape[0]):
        every |= tables.bit[k]
        if status[k] == SETTLED:
            mask |= tables.bit[k]
    if mask == every and tables.phase[t + 1] == len(tables.end) - 1:
        scores[:] = SAFE
        return UNKNOWN
    table = tables.table[tables.phase[t + 1], mask]
    headings = tables.code.shape[2]
    v, u, h, dv, du = coordinates_ahead(body, tables.pitch, headings, x, y, theta)
    count = find_corners(tables.cell, v, u, corners)
    for m in range(scores.shape[0]):
        if table < 0 or leads_back(body, last, m):
            scores[m] = HOPELESS
            continue
        d, angle = displacement(body, m)
        w = heading_after(headings, h, angle)
        if d == 0.0:
            scores[m] = latest_at(tables, table, corners, count, w)
        else:
            there = find_corners(tables.cell, v + d * dv, u + d * du, ahead)
            scores[m] = latest_at(tables, table, ahead, there, w)
    for k in range(status.shape[0]):
        if rules.kind[k] == EVENTUALLY_ALWAYS and status[k] == PENDING and run[k] > 0:
            over = t + rules.b[k] - rules.c2[k] + 1 - run[k]
            if over < tables.phase.shape[0]:
                spare = _after_dwell(tables, mask | tables.bit[k], every, over, corners, count, h)
                scores[wait] = max(scores[wait], spare + (t + tables.early) + 1.0)
    return count
