"""Continuations out of the tables of latest feasible times: greedily, and by a small beam where slack is
small.

The tables propose, exact simulation decides: every pose here comes from f, every settled obligation from
its predicate.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel, leaf
from specshield.policy.beam import beam
from specshield.policy.progress import (
    ALWAYS,
    EVENTUALLY_ALWAYS,
    PENDING,
    STACK,
    Rules,
    advance,
    read_predicates,
    value_count,
)
from specshield.policy.tables import HOPELESS, Tables, goals_settled, is_broken, score, slack
from specshield.robot.unicycle import Body, simulate, step

PATIENCE = 5  # steps without gain after which the greedy walk is taken to go round in a circle
ESCAPE_GAIN = 2.0  # [steps] later than where it got stuck: what a way out has to reach
ESCAPE_DEPTH = 24
MAX_ESCAPES = 8
NUDGE = 0.02  # [m] a move that contact cuts shorter than this leads nowhere


@kernel
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
        score(body, rules, tables, x, y, theta, t + n, status, run, wait, scores)
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
                if not is_broken(status):
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
        if is_broken(status):
            break
        high, high_n = -np.inf, n - 1  # waiting is no circle: what comes next counts anew
    for rest in range(n, steps):
        motions[rest] = wait
        poses[rest, 0], poses[rest, 1], poses[rest, 2] = x, y, theta
    return goals_settled(rules, status), ahead


@leaf
def _pays_to_wait(rules: Rules, t: int, predicates: NDArray[np.float64], status: NDArray[np.int8]) -> bool:
    """Whether a goal that holds here is still to open, or a dwell to go on."""
    for k in range(status.shape[0]):
        useful = rules.kind[k] == EVENTUALLY_ALWAYS or (rules.kind[k] != ALWAYS and rules.a[k] > t)
        if useful and status[k] == PENDING and predicates[k] > rules.margin:
            return True
    return False


@kernel
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
        if over or is_broken(status):
            break
    motions[n:] = wait
    for rest in range(n, steps):
        poses[rest, 0], poses[rest, 1], poses[rest, 2] = x, y, theta
    return goals_settled(rules, status)


@leaf
def _undoing(body: Body, pose: NDArray[np.float64], reached: NDArray[np.float64]) -> int:
    """The motion that leads from `reached` back to `pose`, -1 where it is the same, -2 where none does."""
    if _same(pose[0], pose[1], pose[2], reached):
        return -1
    for m in range(body.translate.shape[0]):
        x, y, theta = step(body, reached[0], reached[1], reached[2], m)
        if _same(x, y, theta, pose):
            return m
    return -2


@leaf
def _same(x: float, y: float, theta: float, pose: NDArray[np.float64]) -> bool:
    turn = abs(theta - pose[2])
    return bool(abs(x - pose[0]) + abs(y - pose[1]) < 1e-6 and min(turn, 2.0 * math.pi - turn) < 1e-6)


@kernel
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
