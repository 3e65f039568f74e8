"""The tables as decisions read them: what leads a robot, the slack of a pose, and where it grows."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bytes, Codes, Floats, Int8s, Int32s, Ints
from specshield.compiled import Boxed, inlined, kernel, leaf
from specshield.policy.lattice import (
    INVALID,
    STEP_CODES,
    Corners,
    beside,
    coordinates,
    find_corners,
    leads_back,
)
from specshield.policy.progress import ALWAYS, BROKEN, EVENTUALLY_ALWAYS, PENDING, SETTLED, Rules
from specshield.robot.dynamics import Body, unhindered

HOPELESS = -1e9  # in place of a slack or a latest time [steps], where nothing is feasible
LATE = -3.0  # [steps] `Tables.late` where it was not measured (latest.py). Chosen by hand.
SAFE = 1e6  # in place of a slack [steps], where nothing is left to do
UNKNOWN = -1  # in place of how many corners there are about a place
DELAYS = (0, 1, 2, 4, 8)  # [steps] that a robot which cannot wait would like to have to spare


class Tables(NamedTuple):
    """Latest feasible times (latest.py), or feasibility step by step (stepwise.py), over the cells that have
    a valid pose.

    cell [ny, nx]: row of `code`, -1 where no pose is valid. code [P, cells, H]: INVALID, 0 for never, else
    1 + STEP_CODES * L. table [phases, 2^G]: which one a set of settled goals has in a phase, -1 for none.
    phase [T + 1]: of each step; end [phases]: its last step. bit [K]: the obligation's bit in a set of
    settled goals, 0 for an `always`. bits [T + 1, cells, H, bytes], stride, dwell [K]: see stepwise.py; bits
    has no steps if the tables are latest times. early [steps]: by how much deadlines are to be met earlier
    than the latest times were computed for. late [steps]: the least slack with which ways are looked for. It
    is negative, since the tables err.
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
    late: float


class Guide(NamedTuple):
    """What leads a robot. wait: the motion that stands still, -1 where there is none. barred [n, 6]: motions
    that led nowhere, and from where (caution/surprise/barred.py).
    """

    body: Body
    rules: Rules
    tables: Tables
    wait: int
    barred: Floats


@kernel
def guided(boxed: Boxed[Guide], margin: float) -> Guide:
    """The guide for one decision, by a margin [m], with signals of its own, which `replay` changes."""
    body, rules, tables, wait, barred = boxed.value
    kind, a, b, c1, c2, last, programs, regions, signals, _ = rules
    rules = Rules(kind, a, b, c1, c2, last, programs, regions, signals.copy(), margin)
    return Guide(body, rules, tables, wait, barred)


class Scratch(NamedTuple):
    """The arrays that one decision works on, made once.

    status, run (K,): the progress at the newest pose; high_status, high_run (K,): where the latest feasible
    time was highest. predicates (K,): their robustness at the newest pose, where it was needed. scores (M,):
    the latest feasible time after each motion. values, stack: of `evaluate_packed`. corners, ahead: of
    `score` and `slack`.
    """

    values: Floats
    stack: Floats
    predicates: Floats
    scores: Floats
    status: Int8s
    run: Ints
    high_status: Int8s
    high_run: Ints
    corners: Corners
    ahead: Corners


@inlined
def latest_at(code: Codes, corners: Corners, count: int, h: float) -> float:
    """L at the first `count` of the corners about a place: linear in x, y and heading over those that are
    valid, HOPELESS where none is. code [cells, H]: of a table.
    """
    low, high, f = beside(h, code.shape[1])
    total, weights = 0.0, 0.0
    for n in range(count):
        row, across = corners.row[n], corners.weight[n]
        w, found = across * (1.0 - f), code[row, low]
        if w >= 1e-9 and found != INVALID:
            total += w * (int(found) - 1.0)
            weights += w
        w, found = across * f, code[row, high]
        if w >= 1e-9 and found != INVALID:
            total += w * (int(found) - 1.0)
            weights += w
    return total / (STEP_CODES * weights) if weights > 1e-6 else HOPELESS


@inlined
def settled_goals(tables: Tables, status: Int8s) -> int:
    """The set of the goals that are settled, as bits."""
    mask = 0
    for k in range(status.shape[0]):
        if status[k] == SETTLED:
            mask |= tables.bit[k]
    return mask


@inlined
def _nothing_left(tables: Tables, t: int, mask: int) -> bool:
    """Whether the goals of `mask` are all that there are, and no `always` is still to begin at step t."""
    return bool(mask == tables.table.shape[1] - 1 and tables.phase[t] == len(tables.end) - 1)


@leaf
def slack(guide: Guide, x: float, y: float, theta: float, t: int, scratch: Scratch) -> float:
    """Steps to spare at x_t with the scratch's progress: L - t - early. SAFE once every goal is settled,
    HOPELESS where something is broken.
    """
    return slack_at(guide, x, y, theta, t, scratch, scratch.corners, UNKNOWN)


@inlined
def slack_at(
    guide: Guide, x: float, y: float, theta: float, t: int, scratch: Scratch, corners: Corners, count: int
) -> float:
    """`slack`, inlined. corners: those about (x, y) where `count` says how many, else scratch."""
    tables = guide.tables
    if tables.bits.shape[0] > 0:
        return _steps_ahead(guide, x, y, theta, t, scratch)
    if is_broken(scratch.status):
        return HOPELESS
    mask = settled_goals(tables, scratch.status)
    if _nothing_left(tables, t, mask):
        return SAFE
    v, u, h = coordinates(guide.body, tables.pitch, tables.code.shape[2], x, y, theta)
    if count == UNKNOWN:
        count = find_corners(tables.cell, v, u, corners)
    at_once = _slack_with(tables, mask, t, corners, count, h)
    return max(at_once, _after_dwells(guide, mask, t, corners, count, h, scratch))


@inlined
def number_of(stride: Ints, dwell: Ints, status: Int8s, run: Ints) -> int:
    """The progress as one number (stepwise.py), without the `always`. stride, dwell, status, run (K,)."""
    number = 0
    for k in range(status.shape[0]):
        number += stride[k] * (min(run[k], dwell[k]) if status[k] == PENDING else dwell[k] + 1)
    return number


@leaf
def _steps_ahead(guide: Guide, x: float, y: float, theta: float, t: int, scratch: Scratch) -> float:
    """How feasible a pose is by step tables: 0 to 1 at step t, and 0 to 1 more for each of DELAYS after which
    it would still be so. SAFE once nothing is pending, HOPELESS if it is not feasible at all.
    """
    tables = guide.tables
    if is_broken(scratch.status):
        return HOPELESS
    if PENDING not in scratch.status:
        return SAFE
    progress = number_of(tables.stride, tables.dwell, scratch.status, scratch.run)
    v, u, h = coordinates(guide.body, tables.pitch, tables.code.shape[2], x, y, theta)
    count, ahead = find_corners(tables.cell, v, u, scratch.corners), 0.0
    for delay in DELAYS:
        if t + delay >= tables.bits.shape[0]:
            break
        ahead += _feasible_at(tables, t + delay, progress, scratch.corners, count, h)
        if ahead == 0.0:
            return HOPELESS
    return ahead


@leaf
def _feasible_at(tables: Tables, t: int, progress: int, corners: Corners, count: int, h: float) -> float:
    """The share of the corners about a place, by weight, from which the rule can be kept at step t."""
    headings, k, share = tables.bits.shape[2], int(np.floor(h)), 0.0
    for n in range(count):
        for up in range(2):
            bits = tables.bits[t, corners.row[n], (k + up) % headings, progress >> 3]
            if bits >> (progress & 7) & 1:
                share += corners.weight[n] * (h - k if up else 1.0 - h + k)
    return share


@inlined
def _slack_with(tables: Tables, mask: int, t: int, corners: Corners, count: int, h: float) -> float:
    """The slack at step t at the corners about a place, with the goals of `mask` settled."""
    if _nothing_left(tables, t, mask):
        return float(tables.end[-1] - (t + tables.early))
    table = tables.table[tables.phase[t], mask]
    return latest_at(tables.code[table], corners, count, h) - (t + tables.early) if table >= 0 else HOPELESS


@inlined
def _after_dwells(
    guide: Guide, mask: int, t: int, corners: Corners, count: int, h: float, scratch: Scratch
) -> float:
    """The slack if the robot stays until a dwell that is under way at step t is over; -inf if none is."""
    rules, tables, best = guide.rules, guide.tables, -np.inf
    for k in range(scratch.status.shape[0]):
        if rules.kind[k] == EVENTUALLY_ALWAYS and scratch.status[k] == PENDING and scratch.run[k] > 0:
            over = t + rules.b[k] - rules.c2[k] + 1 - scratch.run[k]
            if over < tables.phase.shape[0]:
                best = max(best, _slack_with(tables, mask | tables.bit[k], over, corners, count, h))
    return best


@inlined
def goals_settled(rules: Rules, status: Int8s) -> bool:
    for k in range(status.shape[0]):
        if status[k] == BROKEN or (rules.kind[k] != ALWAYS and status[k] == PENDING):
            return False
    return True


@inlined
def is_broken(status: Int8s) -> bool:
    return BROKEN in status


@inlined
def score(
    guide: Guide, x: float, y: float, theta: float, t: int, last: int, some: tuple[int, int], scratch: Scratch
) -> int:
    """Writes L where each motion from x_t ends if it meets nothing into scratch.scores, without the progress
    of that step: a cheap order in which to try motions. To the last bit, `slack_at` then has the same of
    motions that change no progress.

    last: the motion before, -1 for none; motions that lead straight back are HOPELESS, since the tables err
    by a little. some: the first motion that is scored, and the stride to the next; others are HOPELESS.
    Writes the corners about (x, y) into scratch.corners and returns how many there are, UNKNOWN if they were
    not needed.
    """
    body, _, tables, wait, _ = guide
    cos, sin = math.cos(theta), math.sin(theta)
    scores, mask = scratch.scores, settled_goals(tables, scratch.status)
    if tables.bits.shape[0] > 0 or _nothing_left(tables, t + 1, mask):
        scores[:] = SAFE
        return UNKNOWN
    table, headings = tables.table[tables.phase[t + 1], mask], tables.code.shape[2]
    v, u, h = coordinates(body, tables.pitch, headings, x, y, theta)
    count = find_corners(tables.cell, v, u, scratch.corners)
    scores[:] = HOPELESS
    for m in range(some[0], scores.shape[0], some[1]):
        if table < 0 or leads_back(body, last, m):
            continue
        end_x, end_y, heading = unhindered(body, x, y, theta, cos, sin, m)
        to_v, to_u, w = coordinates(body, tables.pitch, headings, end_x, end_y, heading)
        if end_x == x and end_y == y:
            scores[m] = latest_at(tables.code[table], scratch.corners, count, w)
        else:
            there = find_corners(tables.cell, to_v, to_u, scratch.ahead)
            scores[m] = latest_at(tables.code[table], scratch.ahead, there, w)
    spare = _after_dwells(guide, mask, t, scratch.corners, count, h, scratch)
    scores[wait] = max(scores[wait], spare + (t + tables.early) + 1.0)
    return count
