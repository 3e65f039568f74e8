"""A beam over the tables: several ways at once, where one alone comes too late or gets stuck."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel, leaf
from specshield.policy.progress import STACK, Rules, advance, read_predicates, value_count
from specshield.policy.tables import SAFE, Tables, score, slack
from specshield.robot.unicycle import Body, step


@kernel
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
                score(
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


@leaf
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
