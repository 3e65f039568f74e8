"""Continuations out of the tables of latest feasible times: greedily, and by a small beam where slack is
small.

The tables propose, exact simulation decides: every pose here comes from f, every settled obligation from
its predicate.
"""

from __future__ import annotations

import math
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
from specshield.robot.unicycle import Body, simulate, step

SCALE = 64.0  # table codes a step
INVALID = 65535  # code of a pose that is in collision or breaks a lasting `always`
HOPELESS = -1e9
SAFE = 1e6
PATIENCE = 5  # steps without gain after which the greedy walk is taken to go round in a circle
ESCAPE_GAIN = 2.0  # [steps] later than where it got stuck: what a way out has to reach
ESCAPE_DEPTH = 24
MAX_ESCAPES = 8
NUDGE = 0.02  # [m] a move that contact cuts shorter than this leads nowhere


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


@njit(cache=True, nogil=True)
def latest_at(tables: Tables, table: int, v: float, u: float, h: float) -> float:
    """L at lattice coordinates: linear in x, y and heading over the corners that are valid; HOPELESS where
    none is.
    """
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


@njit(cache=True, nogil=True)
def _after_dwell(tables: Tables, mask: int, every: int, t: int, v: float, u: float, h: float) -> float:
    """The slack once a dwell is over, at step t and where it was begun."""
    if mask == every and tables.phase[t] == len(tables.end) - 1:
        return float(tables.end[-1] - t)
    table = tables.table[tables.phase[t], mask]
    return latest_at(tables, table, v, u, h) - t if table >= 0 else HOPELESS


@njit(cache=True, nogil=True)
def goals_settled(rules: Rules, status: NDArray[np.int8]) -> bool:
    for k in range(status.shape[0]):
        if status[k] == BROKEN or (rules.kind[k] != ALWAYS and status[k] == PENDING):
            return False
    return True


@njit(cache=True, nogil=True)
def _score(
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
    scores: NDArray[np.float64],
) -> None:
    """L after each motion (M,) from x_t, contact and the step's own progress left out: a cheap order to try
    motions
    in.
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
    for m in range(scores.shape[0]):
        d = body.translate[m]
        w = h + body.rotate[m] * headings / (2.0 * math.pi)
        if w < 0.0:
            w += headings
        scores[m] = latest_at(tables, table, v + d * sin, u + d * cos, w) if table >= 0 else HOPELESS
    for k in range(status.shape[0]):
        if rules.kind[k] == EVENTUALLY_ALWAYS and status[k] == PENDING and run[k] > 0:
            over = t + rules.b[k] - rules.c2[k] + 1 - run[k]
            if over < tables.phase.shape[0]:
                spare = _after_dwell(tables, mask | tables.bit[k], every, over, v, u, h)
                scores[wait] = max(scores[wait], spare + t + 1.0)


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
    width: int,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> tuple[bool, float]:
    """Follows the latest feasible time uphill from (x_t, t) to the horizon, after the motion `first`.

    Where the tables lead it round in a circle, a beam of `width` looks for a way out. status, run (K,):
    progress
    after x_t, left as they are. Writes motions (T - t,), poses (T - t, 3). Returns whether every goal was
    settled
    and nothing broken, and the slack after the first motion.
    """
    k_count, steps = status.shape[0], motions.shape[0]
    status, run = status.copy(), run.copy()
    kept_status, kept_run = np.empty_like(status), np.empty_like(run)
    values, stack, predicates = np.empty(value_count(rules)), np.empty(STACK), np.empty(k_count)
    scores = np.empty(body.translate.shape[0])
    x, y, theta = step(body, pose[0], pose[1], pose[2], first)
    read_predicates(rules, x, y, theta, values, stack, predicates)
    advance(rules, t + 1, predicates, status, run)
    ahead = slack(body, rules, tables, x, y, theta, t + 1, status, run)
    last_phase = len(tables.end) - 1
    motions[0] = first
    poses[0, 0], poses[0, 1], poses[0, 2] = x, y, theta
    n = 1
    high, high_n, escapes = ahead + t + 1, n, 0  # the latest time reached so far, and the state there
    high_pose, high_status, high_run = poses[0].copy(), status.copy(), run.copy()
    while n < steps and not (goals_settled(rules, status) and tables.phase[t + n] == last_phase):
        if n > high_n:
            value = slack(body, rules, tables, x, y, theta, t + n, status, run) + t + n
            if value > high + 0.25 or np.any(status != high_status):
                high, high_n = value, n
                high_pose[0], high_pose[1], high_pose[2] = x, y, theta
                high_status[:], high_run[:] = status, run
            elif n - high_n >= PATIENCE:
                if escapes == MAX_ESCAPES:
                    break
                escapes += 1
                depth = min(steps - high_n, ESCAPE_DEPTH)
                taken = beam(
                    body, rules, tables, high_pose, t + high_n, high_status, high_run, -1, wait, width,
                    0.5 * HOPELESS, high + ESCAPE_GAIN, motions[high_n : high_n + depth],
                )  # fmt: skip
                if taken == 0:
                    break
                x, y, theta = high_pose[0], high_pose[1], high_pose[2]
                status[:], run[:] = high_status, high_run
                for n in range(high_n, high_n + taken):
                    x, y, theta = step(body, x, y, theta, motions[n])
                    poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
                    read_predicates(rules, x, y, theta, values, stack, predicates)
                    advance(rules, t + n + 1, predicates, status, run)
                n = high_n + taken
                continue
        _score(body, rules, tables, x, y, theta, t + n, status, run, wait, scores)
        phase = tables.phase[t + n + 1]
        waits_for_phase = phase < last_phase and scores[wait] >= tables.end[phase] - 0.1
        if not waits_for_phase and not _pays_to_wait(rules, t + n, predicates, status):
            scores[wait] = HOPELESS
        last = motions[n - 1]
        for m in range(scores.shape[0]):  # tables err by a little: never straight back
            if body.translate[m] * body.translate[last] < 0.0 or body.rotate[m] * body.rotate[last] < 0.0:
                scores[m] = HOPELESS
        chosen = -1
        while True:
            best = wait  # waiting wins ties
            for m in range(scores.shape[0]):
                if scores[m] > scores[best]:
                    best = m
            if best == wait or scores[best] <= HOPELESS:
                break
            nx, ny, nth = step(body, x, y, theta, best)
            if abs(nx - x) + abs(ny - y) > NUDGE or nth != theta:
                kept_status[:], kept_run[:] = status, run
                read_predicates(rules, nx, ny, nth, values, stack, predicates)
                advance(rules, t + n + 1, predicates, status, run)
                if not _is_broken(status):
                    chosen = best
                    x, y, theta = nx, ny, nth
                    break
                status[:], run[:] = kept_status, kept_run
            scores[best] = HOPELESS
        if chosen >= 0:
            motions[n] = chosen
            poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
            n += 1
            continue
        # Waiting is best until something it brings about changes the progress.
        kept_status[:] = status
        read_predicates(rules, x, y, theta, values, stack, predicates)
        while n < steps:
            advance(rules, t + n + 1, predicates, status, run)
            motions[n] = wait
            poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
            n += 1
            if np.any(status != kept_status) or n == steps or tables.phase[t + n + 1] != phase:
                break
        if _is_broken(status):
            break
        high, high_n = -np.inf, n - 1  # waiting is no circle: what comes next counts anew
    for rest in range(n, steps):
        motions[rest] = wait
        poses[rest, 0], poses[rest, 1], poses[rest, 2] = x, y, theta
    return goals_settled(rules, status), ahead


@njit(cache=True, nogil=True)
def _pays_to_wait(rules: Rules, t: int, predicates: NDArray[np.float64], status: NDArray[np.int8]) -> bool:
    """Whether a goal that holds here is still to open, or a dwell to go on."""
    for k in range(status.shape[0]):
        useful = rules.kind[k] == EVENTUALLY_ALWAYS or (rules.kind[k] != ALWAYS and rules.a[k] > t)
        if useful and status[k] == PENDING and predicates[k] > rules.margin:
            return True
    return False


@njit(cache=True, nogil=True)
def _is_broken(status: NDArray[np.int8]) -> bool:
    return bool(np.any(status == BROKEN))


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
    band: float,
    target: float,
    motions: NDArray[np.int64],
) -> int:
    """Keeps the `width` poses with the most slack at every step, until one has settled every goal or has a
    latest
    feasible time above `target`.

    first: the first motion, -1 for any. band: poses with less slack than this are given up. Returns how
    many of
    motions (n,) it took, 0 where none was found.
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
    scores = np.empty(m_count)
    parent = np.empty((steps, width), np.int32)
    taken = np.empty((steps, width), np.int16)
    for n in range(steps):
        found = 0
        for w in range(count):
            if n > 0 or first < 0:
                _score(
                    body,
                    rules,
                    tables,
                    here[w, 0],
                    here[w, 1],
                    here[w, 2],
                    t + n,
                    here_status[w],
                    here_run[w],
                    wait,
                    scores,
                )
            for m in range(m_count):
                if m != first if n == 0 and first >= 0 else scores[m] - (t + n + 1) < band:
                    continue
                x, y, theta = step(body, here[w, 0], here[w, 1], here[w, 2], m)
                read_predicates(rules, x, y, theta, values, stack, predicates)
                new_status[found], new_run[found] = here_status[w], here_run[w]
                advance(rules, t + n + 1, predicates, new_status[found], new_run[found])
                ahead = slack(body, rules, tables, x, y, theta, t + n + 1, new_status[found], new_run[found])
                if ahead < band:
                    continue
                new[found, 0], new[found, 1], new[found, 2] = x, y, theta
                new_slack[found], new_from[found], new_motion[found] = ahead, w, m
                found += 1
                if ahead == SAFE or ahead + (t + n + 1) > target:
                    motions[n] = m
                    for back in range(n - 1, -1, -1):
                        motions[back] = taken[back, w]
                        w = parent[back, w]
                    return n + 1
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
            return 0
    return 0


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
def retrace(
    body: Body,
    rules: Rules,
    tables: Tables,
    pose: NDArray[np.float64],
    t: int,
    status: NDArray[np.int8],
    run: NDArray[np.int64],
    first: int,
    back: int,
    wait: int,
    base: NDArray[np.int64],
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> bool:
    """Tries `first`, the motion `back` that undoes it (-1: none is needed), then `base`, a way from x_t to
    every goal.

    The steps lost are made up for where `base` (T - t,) waits. Other arguments and result as `greedy`.
    """
    steps, last_phase = motions.shape[0], len(tables.end) - 1
    status, run = status.copy(), run.copy()
    values, stack, predicates = np.empty(value_count(rules)), np.empty(STACK), np.empty(status.shape[0])
    behind = 1 if back < 0 else 2
    x, y, theta = pose[0], pose[1], pose[2]
    n, at = 0, 0
    while n < steps:
        if n == 0:
            motion = first
        elif n == 1 and back >= 0:
            motion = back
        else:
            while behind > 0 and at < steps and base[at] == wait:
                at += 1
                behind -= 1
            motion = base[at] if at < steps else wait
            at += 1
        x, y, theta = step(body, x, y, theta, motion)
        motions[n] = motion
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
        n += 1
        read_predicates(rules, x, y, theta, values, stack, predicates)
        advance(rules, t + n, predicates, status, run)
        over = goals_settled(rules, status) and tables.phase[t + n] == last_phase
        if over or _is_broken(status):
            break
    motions[n:] = wait
    for rest in range(n, steps):
        poses[rest, 0], poses[rest, 1], poses[rest, 2] = x, y, theta
    return goals_settled(rules, status)


@njit(cache=True, nogil=True)
def _undoing(body: Body, pose: NDArray[np.float64], reached: NDArray[np.float64]) -> int:
    """The motion that leads from `reached` back to `pose`, -1 where it is the same, -2 where none does."""
    if _same(pose[0], pose[1], pose[2], reached):
        return -1
    for m in range(body.translate.shape[0]):
        x, y, theta = step(body, reached[0], reached[1], reached[2], m)
        if _same(x, y, theta, pose):
            return m
    return -2


@njit(cache=True, nogil=True)
def _same(x: float, y: float, theta: float, pose: NDArray[np.float64]) -> bool:
    turn = abs(theta - pose[2])
    return abs(x - pose[0]) + abs(y - pose[1]) < 1e-6 and min(turn, 2.0 * math.pi - turn) < 1e-6


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
    """A continuation a first motion, into motions (M, T - t) and poses (M, T - t, 3); returns the motion of
    most
    slack.

    The motion of most slack is walked out greedily. For any other it is enough to undo it and go the same
    way; where
    that comes too late it is walked out itself, and where the walk fails though the tables see at least
    `band` steps
    of slack (they err a little), a beam looks all the way.
    """
    count, steps = motions.shape
    slacks, undo = np.empty(count), np.empty(count, np.int64)
    values, stack, predicates = np.empty(value_count(rules)), np.empty(STACK), np.empty(status.shape[0])
    for m in range(count):
        x, y, theta = step(body, pose[0], pose[1], pose[2], m)
        poses[m, 0, 0], poses[m, 0, 1], poses[m, 0, 2] = x, y, theta
        undo[m] = _undoing(body, pose, poses[m, 0])
        after_status, after_run = status.copy(), run.copy()
        read_predicates(rules, x, y, theta, values, stack, predicates)
        advance(rules, t + 1, predicates, after_status, after_run)
        slacks[m] = slack(body, rules, tables, x, y, theta, t + 1, after_status, after_run)
    preferred = wait if slacks[wait] == slacks.max() else int(np.argmax(slacks))
    base, found = -1, np.empty(steps, np.int64)
    for m in np.argsort(-slacks, kind="mergesort"):
        settled = False
        if base >= 0 and undo[m] >= -1:
            settled = retrace(
                body,
                rules,
                tables,
                pose,
                t,
                status,
                run,
                m,
                undo[m],
                wait,
                motions[base],
                motions[m],
                poses[m],
            )
        hopeful = slacks[m] >= band
        if not settled and (hopeful or base < 0 or undo[m] < -1):
            settled, _ = greedy(
                body, rules, tables, pose, t, status, run, m, wait, width, motions[m], poses[m]
            )
        if not settled and hopeful:
            taken = beam(body, rules, tables, pose, t, status, run, m, wait, width, band, np.inf, found)
            if taken > 0:
                settled = True
                motions[m, :taken] = found[:taken]
                motions[m, taken:] = wait
                simulate(body, pose, motions[m], poses[m])
        if settled and base < 0:
            base = m
    return preferred
