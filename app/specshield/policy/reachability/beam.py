"""A beam over the tables: several ways at once, where following the tables comes too late or gets stuck.

One beam serves every first motion that is still open. Ways that meet go on as one, for all the motions they
began with, and each motion has its share of the poses that are kept.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import inlined, kernel, leaf
from specshield.policy.reachability.tables import SAFE, is_broken, score, slack
from specshield.policy.reachability.work import Guide, Work, observe
from specshield.robot.dynamics import motion_count, step

MAX_ROOTS = 62  # bits of a tag
ROOM = 128  # poses kept at a step, at most
MANY = 16  # motions from a pose: of more, only those that are nearly the best
EASY = 8.0  # [steps] of slack after a goal was settled: from there the tables can be followed again
TWIN = 1e3  # [1/m, 1/rad] poses as near as a millimetre count as one


class Poses(NamedTuple):
    """Poses with their progress, slack, and the roots that lead to them, as bits."""

    pose: NDArray[np.float64]
    status: NDArray[np.int8]
    run: NDArray[np.int64]
    slack: NDArray[np.float64]
    tag: NDArray[np.int64]


class Edges(NamedTuple):
    """What led to the poses kept at each step: [steps, edges], made [steps] of them; tag [steps, poses] as in
    `Poses`.
    """

    child: NDArray[np.int32]
    parent: NDArray[np.int32]
    motion: NDArray[np.int32]
    made: NDArray[np.int64]
    tag: NDArray[np.int64]


@kernel
def beam(
    guide: Guide,
    t: int,
    pose: NDArray[np.float64],
    status: NDArray[np.int8],
    run: NDArray[np.int64],
    share: int,
    band: float,
    target: float,
    work: Work,
    motions: NDArray[np.int64],
    taken: NDArray[np.int64],
) -> None:
    """Keeps the poses with the most slack at every step until each root has a way, or none is left.

    pose (R, 3), status, run (R, K): the roots, at step t, R <= MAX_ROOTS. share: poses kept for each root.
    band: poses with less slack than this are given up. A way ends where every goal is settled, where one
    more is and EASY steps are to spare, or where the latest feasible time is above `target`. Writes motions
    (R, n) and how many of them lead there, taken (R,), 0 where no way was found.
    """
    roots, k_count = status.shape
    steps = motions.shape[1]
    width = max(min(share * roots, ROOM), share)
    room = width * motion_count(guide.body)
    here, new = _poses(width, k_count), _poses(room, k_count)
    edges = Edges(
        np.empty((steps, room), np.int32), np.empty((steps, room), np.int32),
        np.empty((steps, room), np.int32), np.zeros(steps, np.int64), np.zeros((steps, width), np.int64),
    )  # fmt: skip
    slots = 4
    while slots < 2 * room:
        slots *= 2
    table, place, kept = np.empty(slots, np.int32), np.empty(room, np.int64), np.empty(roots, np.int64)
    here.pose[:roots], here.status[:roots], here.run[:roots] = pose, status, run
    here.tag[:roots] = 1 << np.arange(roots)
    taken[:] = 0
    open_roots, count = (1 << roots) - 1, roots
    for n in range(steps):
        table[:] = -1
        found = _expand(guide, t, n, count, open_roots, band, here, new, edges, table, work)
        open_roots = _finish(t, n, found, open_roots, target, status, new, edges, motions, taken)
        if open_roots == 0:
            return
        order = np.argsort(-new.slack[:found], kind="mergesort")
        count = _select(order, n, open_roots, width, share, band, kept, place, here, new, edges)
        if count == 0:
            return


@kernel
def _poses(n: int, k: int) -> Poses:
    return Poses(
        np.empty((n, 3)),
        np.empty((n, k), np.int8),
        np.empty((n, k), np.int64),
        np.empty(n),
        np.empty(n, np.int64),
    )


@leaf
def _copy(from_: Poses, i: int, to: Poses, j: int) -> None:
    for d in range(3):
        to.pose[j, d] = from_.pose[i, d]
    for k in range(from_.status.shape[1]):
        to.status[j, k], to.run[j, k] = from_.status[i, k], from_.run[i, k]


@inlined
def _put(to: Poses, i: int, x: float, y: float, theta: float, work: Work) -> None:
    to.pose[i, 0], to.pose[i, 1], to.pose[i, 2] = x, y, theta
    for k in range(to.status.shape[1]):
        to.status[i, k], to.run[i, k] = work.status[k], work.run[k]


@leaf
def _expand(
    guide: Guide,
    t: int,
    n: int,
    count: int,
    open_roots: int,
    band: float,
    here: Poses,
    new: Poses,
    edges: Edges,
    table: NDArray[np.int32],
    work: Work,
) -> int:
    """Every motion from every pose kept, into `new`, twins once; returns how many."""
    body, rules, tables, wait = guide
    found, joined = 0, 0
    for w in range(count):
        edges.tag[n, w] = here.tag[w]
        if here.tag[w] & open_roots == 0:
            continue
        x, y, theta = here.pose[w, 0], here.pose[w, 1], here.pose[w, 2]
        score(body, rules, tables, x, y, theta, t + n, here.status[w], here.run[w], wait, -1, work.scores)
        lowest = max(band + t + n + 1, _lowest(work.scores))
        for m in range(motion_count(body)):
            if work.scores[m] < lowest:
                continue
            x, y, theta = step(body, here.pose[w, 0], here.pose[w, 1], here.pose[w, 2], m)
            for k in range(here.status.shape[1]):
                work.status[k], work.run[k] = here.status[w, k], here.run[w, k]
            observe(rules, t + n + 1, x, y, theta, work)
            _put(new, found, x, y, theta, work)
            at = _place(new, found, table)
            if at == found:
                new.slack[at] = slack(
                    body, rules, tables, x, y, theta, t + n + 1, new.status[at], new.run[at]
                )
                new.tag[at] = 0
                found += 1
            if new.slack[at] >= band and not is_broken(new.status[at]):
                new.tag[at] |= here.tag[w]
                edges.child[n, joined], edges.parent[n, joined], edges.motion[n, joined] = at, w, m
                joined += 1
    edges.made[n] = joined
    return found


@leaf
def _lowest(scores: NDArray[np.float64]) -> float:
    """The score from which on a motion is tried: of many motions only those that are nearly the best."""
    if scores.shape[0] <= MANY:
        return -np.inf
    best = -np.inf
    for m in range(scores.shape[0]):
        best = max(best, scores[m])
    gap = 4.0
    while gap > 0.1:
        count = 0
        for m in range(scores.shape[0]):
            count += scores[m] >= best - gap
        if count <= MANY:
            break
        gap *= 0.5
    return best - gap


@leaf
def _finish(
    t: int,
    n: int,
    found: int,
    open_roots: int,
    target: float,
    status: NDArray[np.int8],
    new: Poses,
    edges: Edges,
    motions: NDArray[np.int64],
    taken: NDArray[np.int64],
) -> int:
    """Notes the way of every root that has one now; returns the roots that are still open."""
    for c in range(found):
        arrived = new.tag[c] & open_roots
        ahead = new.slack[c]
        if arrived == 0 or ahead < min(EASY, target - (t + n + 1)):
            continue
        for r in range(status.shape[0]):
            if arrived >> r & 1 == 0:
                continue
            gained = ahead == SAFE or ahead + (t + n + 1) > target
            for k in range(status.shape[1]):
                gained = gained or new.status[c, k] != status[r, k]
            if gained:
                _trace(n, c, r, edges, motions[r])
                taken[r] = n + 1
                open_roots &= ~(1 << r)
    return open_roots


@leaf
def _select(
    order: NDArray[np.int64],
    n: int,
    open_roots: int,
    width: int,
    share: int,
    band: float,
    kept: NDArray[np.int64],
    place: NDArray[np.int64],
    here: Poses,
    new: Poses,
    edges: Edges,
) -> int:
    """The poses of `new` to go on with, into `here`: the most slack first, until each root has its share."""
    for r in range(kept.shape[0]):
        kept[r] = 0
    count, full = 0, 0  # full: the roots that have their share
    for i in range(order.shape[0]):
        o = order[i]
        place[o] = -1
        tag = new.tag[o] & open_roots
        if count == width or new.slack[o] < band or tag & ~full == 0:
            continue
        for r in range(kept.shape[0]):
            kept[r] += tag >> r & 1
            if kept[r] >= share:
                full |= 1 << r
        _copy(new, o, here, count)
        here.tag[count], place[o] = tag, count
        count += 1
    joined = 0
    for e in range(edges.made[n]):
        at = place[edges.child[n, e]]
        if at >= 0:
            edges.child[n, joined], edges.parent[n, joined] = at, edges.parent[n, e]
            edges.motion[n, joined] = edges.motion[n, e]
            joined += 1
    edges.made[n] = joined
    return count


@leaf
def _place(new: Poses, found: int, table: NDArray[np.int32]) -> int:
    """The pose that `found` is a twin of, progress included; else `found` itself, noted in the table."""
    x, y, theta = _rounded(new.pose, found)
    key = x * 73856093 ^ y * 19349663 ^ theta * 83492791
    for k in range(new.status.shape[1]):
        key = key * 31 + 4 * new.run[found, k] + new.status[found, k]
    slot = (key ^ key >> 15) & (table.shape[0] - 1)
    while table[slot] >= 0:
        other = table[slot]
        a, b, c = _rounded(new.pose, other)
        same = a == x and b == y and c == theta
        for k in range(new.status.shape[1]):
            same = same and new.status[found, k] == new.status[other, k]
            same = same and new.run[found, k] == new.run[other, k]
        if same:
            return int(other)
        slot = (slot + 1) & (table.shape[0] - 1)
    table[slot] = found
    return found


@leaf
def _rounded(poses: NDArray[np.float64], i: int) -> tuple[int, int, int]:
    return (
        math.floor(TWIN * poses[i, 0] + 0.5),
        math.floor(TWIN * poses[i, 1] + 0.5),
        math.floor(TWIN * poses[i, 2] + 0.5),
    )


@leaf
def _trace(n: int, at: int, root: int, edges: Edges, motions: NDArray[np.int64]) -> None:
    """The motions from `root` to pose `at` of step n, into motions[:n + 1]."""
    for layer in range(n, -1, -1):
        for e in range(edges.made[layer]):
            if edges.child[layer, e] == at and edges.tag[layer, edges.parent[layer, e]] >> root & 1:
                motions[layer], at = edges.motion[layer, e], edges.parent[layer, e]
                break
