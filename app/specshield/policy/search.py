"""Continuations out of the tables of latest feasible times: greedily, and by a small beam where slack is small.

The tables propose, exact simulation decides: every pose here comes from f, every settled obligation from its predicate.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from specshield.policy.lattice import coordinates
from specshield.policy.progress import (
    ALWAYS,
    BROKEN,
    EVENTUALLY_ALWAYS,
    PENDING,
    SETTLED,
    STACK,
    Rules,
    advance,
    read_predicates,
    value_count,
)
from specshield.robot.unicycle import Body, step

SCALE = 64.0  # table codes a step
INVALID = 65535  # code of a pose that is in collision or breaks a lasting `always`
HOPELESS = -1e9
SAFE = 1e6


class Tables(NamedTuple):
    """Latest feasible times, stored over the cells that have a valid pose.

    cell [ny, nx]: row of `code`, -1 where no pose is valid. code [P, cells, H]: INVALID, 0 for never, else
    1 + SCALE * L. index [2^G]: which table a set of settled goals has, -1 if it has none. bit [K]: the obligation's bit
    in that set, 0 for an `always`.
    """

    cell: NDArray[np.int32]
    code: NDArray[np.uint16]
    index: NDArray[np.int32]
    bit: NDArray[np.int64]
    pitch: float


@njit(cache=True, nogil=True)
def latest_at(tables: Tables, table: int, v: float, u: float, h: float) -> float:
    """L at lattice coordinates: linear in x, y and heading over the corners that are valid; HOPELESS where none is."""
    ny, nx = tables.cell.shape
    headings = tables.code.shape[2]
    j, i, k = int(np.floor(v)), int(np.floor(u)), int(np.floor(h))
    q, p, f = v - j, u - i, h - k
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
            for dk in range(2):
                w = wi * (f if dk else 1.0 - f)
                if w < 1e-9:
                    continue
                code = tables.code[table, row, (k + dk) % headings]
                if code != INVALID:
                    total += w * (code - 1.0) / SCALE
                    weights += w
    return total / weights if weights > 1e-6 else HOPELESS


@njit(cache=True, nogil=True)
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
    """Steps to spare at (x_t, progress): L - t. SAFE once every goal is settled, HOPELESS where something is broken."""
    mask, every = 0, 0
    for k in range(status.shape[0]):
        if status[k] == BROKEN:
            return HOPELESS
        every |= tables.bit[k]
        if status[k] == SETTLED:
            mask |= tables.bit[k]
    if mask == every:
        return SAFE
    v, u, h = coordinates(body, tables.pitch, tables.code.shape[2], x, y, theta)
    best = HOPELESS
    if tables.index[mask] >= 0:
        best = latest_at(tables, tables.index[mask], v, u, h) - t
    for k in range(status.shape[0]):  # a dwell under way: what is left of it, then the rest
        if rules.kind[k] == EVENTUALLY_ALWAYS and status[k] == PENDING and run[k] > 0:
            ahead = tables.index[mask | tables.bit[k]]
            if ahead >= 0:
                left = rules.b[k] - rules.c2[k] + 1 - run[k]
                best = max(best, latest_at(tables, ahead, v, u, h) - t - left)
    return best


@njit(cache=True, nogil=True)
def goals_settled(rules: Rules, status: NDArray[np.int8]) -> bool:
    for k in range(status.shape[0]):
        if status[k] == BROKEN or (rules.kind[k] != ALWAYS and status[k] == PENDING):
            return False
    return True


@njit(cache=True, nogil=True)
def greedy(
    body: Body,
    rules: Rules,
    tables: Tables,
    pose: NDArray[np.float64],
    t: int,
    status: NDArray[np.int8],
    run: NDArray[np.int64],
    first: int,
    wait: int,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> tuple[bool, float]:
    """Follows the slack uphill from (x_t, t) to the horizon after the motion `first` (-1: its own choice).

    status, run (K,): progress after x_t, left as they are. Writes motions (T - t,), poses (T - t, 3). Returns whether
    every goal was settled and nothing broken, and the slack after the first motion.
    """
    k_count, m_count = status.shape[0], body.translate.shape[0]
    status, run = status.copy(), run.copy()
    trial_status, trial_run = np.empty_like(status), np.empty_like(run)
    best_status, best_run = np.empty_like(status), np.empty_like(run)
    values, stack, predicates = np.empty(value_count(rules)), np.empty(STACK), np.empty(k_count)
    x, y, theta = pose[0], pose[1], pose[2]
    after_first = HOPELESS
    for n in range(motions.shape[0]):
        if (n > 0 or first < 0) and goals_settled(rules, status):
            for rest in range(n, motions.shape[0]):  # waiting keeps what is left
                motions[rest] = wait
                poses[rest, 0], poses[rest, 1], poses[rest, 2] = x, y, theta
            return True, SAFE if n == 0 else after_first
        best, best_slack = wait, -np.inf
        bx, by, bth = x, y, theta
        for trial in range(m_count):
            m = wait if trial == 0 else (trial - 1 if trial <= wait else trial)  # waiting first: it wins ties
            if n == 0 and first >= 0 and m != first:
                continue
            nx, ny, nth = step(body, x, y, theta, m)
            if m != wait and nx == x and ny == y and nth == theta and (n > 0 or first < 0):
                continue
            read_predicates(rules, nx, ny, nth, values, stack, predicates)
            trial_status[:], trial_run[:] = status, run
            advance(rules, t + n + 1, predicates, trial_status, trial_run)
            found = slack(body, rules, tables, nx, ny, nth, t + n + 1, trial_status, trial_run)
            if found > best_slack:
                best, best_slack = m, found
                bx, by, bth = nx, ny, nth
                best_status[:], best_run[:] = trial_status, trial_run
        if n == 0:
            after_first = best_slack
        x, y, theta = bx, by, bth
        status[:], run[:] = best_status, best_run
        motions[n] = best
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
        if best_slack <= 0.5 * HOPELESS:  # nothing left to follow
            for rest in range(n + 1, motions.shape[0]):
                motions[rest] = wait
                poses[rest, 0], poses[rest, 1], poses[rest, 2] = x, y, theta
            return False, after_first
    return goals_settled(rules, status), after_first


@njit(cache=True, nogil=True)
def beam(
    body: Body,
    rules: Rules,
    tables: Tables,
    pose: NDArray[np.float64],
    t: int,
    status: NDArray[np.int8],
    run: NDArray[np.int64],
    first: int,
    wait: int,
    width: int,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> bool:
    """Keeps the `width` poses with the most slack at every step; True once one has settled every goal.

    Arguments as `greedy`; motions and poses are written only on success.
    """
    k_count, m_count, steps = status.shape[0], body.translate.shape[0], motions.shape[0]
    values, stack, predicates = np.empty(value_count(rules)), np.empty(STACK), np.empty(k_count)
    here = np.empty((width, 3))
    here_status, here_run = np.empty((width, k_count), np.int8), np.empty((width, k_count), np.int64)
    here[0], here_status[0], here_run[0] = pose, status, run
    count = 1
    room = width * m_count
    new = np.empty((room, 3))
    new_status, new_run = np.empty((room, k_count), np.int8), np.empty((room, k_count), np.int64)
    new_slack, new_from, new_motion = np.empty(room), np.empty(room, np.int64), np.empty(room, np.int64)
    parent = np.empty((steps, width), np.int32)
    taken = np.empty((steps, width), np.int16)
    for n in range(steps):
        found = 0
        for w in range(count):
            for m in range(m_count):
                if n == 0 and m != first:
                    continue
                x, y, theta = step(body, here[w, 0], here[w, 1], here[w, 2], m)
                read_predicates(rules, x, y, theta, values, stack, predicates)
                new_status[found], new_run[found] = here_status[w], here_run[w]
                advance(rules, t + n + 1, predicates, new_status[found], new_run[found])
                ahead = slack(body, rules, tables, x, y, theta, t + n + 1, new_status[found], new_run[found])
                if ahead <= 0.5 * HOPELESS:
                    continue
                new[found, 0], new[found, 1], new[found, 2] = x, y, theta
                new_slack[found], new_from[found], new_motion[found] = ahead, w, m
                found += 1
                if ahead == SAFE:
                    _write(body, pose, n, w, m, parent, taken, wait, motions, poses)
                    return True
        count = 0
        order = np.argsort(-new_slack[:found], kind="mergesort")
        for o in order:
            if count == width:
                break
            if _is_twin(new, new_status, new_run, o, here, here_status, here_run, count):
                continue
            here[count], here_status[count], here_run[count] = new[o], new_status[o], new_run[o]
            parent[n, count], taken[n, count] = new_from[o], new_motion[o]
            count += 1
        if count == 0:
            return False
    return False


@njit(cache=True, nogil=True)
def _is_twin(
    new: NDArray[np.float64],
    new_status: NDArray[np.int8],
    new_run: NDArray[np.int64],
    o: int,
    here: NDArray[np.float64],
    here_status: NDArray[np.int8],
    here_run: NDArray[np.int64],
    count: int,
) -> bool:
    """Whether a pose as near as a millimetre, with the same progress, is kept already."""
    for w in range(count):
        near = abs(new[o, 0] - here[w, 0]) < 1e-3 and abs(new[o, 1] - here[w, 1]) < 1e-3
        if near and abs(new[o, 2] - here[w, 2]) < 1e-3:
            same = True
            for k in range(new_status.shape[1]):
                same = same and new_status[o, k] == here_status[w, k] and new_run[o, k] == here_run[w, k]
            if same:
                return True
    return False


@njit(cache=True, nogil=True)
def _write(
    body: Body,
    pose: NDArray[np.float64],
    last: int,
    w: int,
    m: int,
    parent: NDArray[np.int32],
    taken: NDArray[np.int16],
    wait: int,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> None:
    motions[last + 1 :] = wait
    motions[last] = m
    for n in range(last - 1, -1, -1):
        motions[n] = taken[n, w]
        w = parent[n, w]
    x, y, theta = pose[0], pose[1], pose[2]
    for n in range(motions.shape[0]):
        x, y, theta = step(body, x, y, theta, motions[n])
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta


@njit(cache=True, nogil=True)
def propose_all(
    body: Body,
    rules: Rules,
    tables: Tables,
    pose: NDArray[np.float64],
    t: int,
    status: NDArray[np.int8],
    run: NDArray[np.int64],
    wait: int,
    width: int,
    band: float,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> int:
    """A continuation a first motion, into motions (M, T - t) and poses (M, T - t, 3); the motion of most slack.

    The beam is tried where the greedy one fails and the table sees at least `band` steps of slack (it errs a little).
    """
    best, best_slack = wait, -np.inf
    for m in range(motions.shape[0]):
        settled, ahead = greedy(body, rules, tables, pose, t, status, run, m, wait, motions[m], poses[m])
        if not settled and ahead >= band:
            settled = beam(body, rules, tables, pose, t, status, run, m, wait, width, motions[m], poses[m])
        if ahead > best_slack or (ahead == best_slack and m == wait):
            best, best_slack = m, ahead
    return best
