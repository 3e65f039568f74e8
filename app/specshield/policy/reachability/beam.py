"""A beam over the tables: many ways at once, where following the tables one way comes too late or gets stuck.

One beam serves several first motions, its roots. Ways that meet go on as one, for all the roots that they
come from, and each root has its share of the poses that are kept.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Int8s, Int32s, Ints
from specshield.compiled import inlined, kernel, leaf
from specshield.policy.lattice import reads_heading
from specshield.policy.progress import advance
from specshield.policy.reachability.guide import copy_progress, read_due
from specshield.policy.reachability.tables import SAFE, UNKNOWN, Guide, Scratch, is_broken, score, slack_at
from specshield.policy.tree import Heap, sink, table_size
from specshield.robot.dynamics import around, motion_count, step_from, unhindered

MAX_ROOTS = 62  # bits of a tag, which is an int64

# Chosen by hand; nothing measured.
MAX_KEPT = 128  # poses kept at a step, unless one root alone has a larger share
MAX_TRIED = 16  # motions from a pose; of more, only those with nearly the best score are tried
MAX_SCORED = 64  # motions from a pose; of more, others have a score at other poses
WIDEST_GAP, NARROWEST_GAP = 4.0, 0.1  # [steps] how far below the best score such a motion may be
EASY = 8.0  # [steps] of slack after a goal was settled: from there the tables can be followed again
POSE_GRAIN = 1e3  # [1/m, 1/rad] poses that are equal after multiplying by this and rounding count once


class Terms(NamedTuple):
    """What one beam is allowed. share: the poses kept for each root. band: a pose with less slack [steps] is
    given up. target: a way may end where the latest feasible time [steps] is above it. every: from each pose
    one motion in so many is tried, from other poses other ones.
    """

    share: int
    band: float
    target: float
    every: int


class Poses(NamedTuple):
    """Poses at one step [N], with the progress, the slack [steps] and the roots they come from, as bits."""

    pose: Floats
    status: Int8s
    run: Ints
    slack: Floats
    tag: Ints


class Edges(NamedTuple):
    """The motions that led from the poses of each step to those of the next.

    child, parent, motion [steps, edges], of which made [steps] count; tag [steps, poses]: as in `Poses`.
    """

    child: Int32s
    parent: Int32s
    motion: Int32s
    made: Ints
    tag: Ints


class Beam(NamedTuple):
    """What one beam works on.

    here: the poses kept at a step, at most `width`; new: those that their motions lead to. begun [R, K]: the
    roots' status at the beginning. table: where the poses of `new` are looked up; place [N]: the row that
    each has in `here`; kept [R]: how many poses each root has there; heap: of the rows of `new`, the most
    slack first. motions (R, n), taken (R,): as `beam_search` returns them.
    """

    terms: Terms
    width: int
    here: Poses
    new: Poses
    edges: Edges
    begun: Int8s
    table: Int32s
    place: Ints
    kept: Ints
    heap: Heap
    motions: Ints
    taken: Ints


@kernel
def beam_search(
    guide: Guide, t: int, pose: Floats, status: Int8s, run: Ints, steps: int, terms: Terms, scratch: Scratch
) -> tuple[Ints, Ints]:
    """Keeps the poses of most slack at every step, until each root has a way or no pose is left.

    pose (R, 3), status, run (R, K): the roots at step t, R <= MAX_ROOTS. steps: of the longest way. A way
    ends where every goal is settled, where one more goal is settled and EASY steps are to spare, or where the
    latest feasible time is above the target. Returns each root's way, motions (R, steps), and its length,
    taken (R,), 0 where none was found.
    """
    roots, k_count = status.shape
    width = max(min(terms.share * roots, MAX_KEPT), terms.share)
    room = width * motion_count(guide.body)
    edges = Edges(
        child=np.empty((steps, room), np.int32),
        parent=np.empty((steps, room), np.int32),
        motion=np.empty((steps, room), np.int32),
        made=np.zeros(steps, np.int64),
        tag=np.zeros((steps, width), np.int64),
    )
    beam = Beam(
        terms=terms,
        width=width,
        here=_poses(width, k_count),
        new=_poses(room, k_count),
        edges=edges,
        begun=status,
        table=np.empty(table_size(room), np.int32),
        place=np.empty(room, np.int64),
        kept=np.empty(roots, np.int64),
        heap=Heap(np.empty(room, np.int32), np.empty(room)),
        motions=np.empty((roots, steps), np.int64),
        taken=np.zeros(roots, np.int64),
    )
    for r in range(roots):
        _put(beam.here, r, pose[r, 0], pose[r, 1], pose[r, 2], status[r], run[r])
        beam.here.tag[r] = 1 << r
    open_roots, count = (1 << roots) - 1, roots
    for n in range(steps):
        found = _expand(guide, t, n, count, open_roots, beam, scratch)
        open_roots = _finish(t, n, found, open_roots, beam)
        count = _select(found, n, open_roots, beam)
        if open_roots == 0 or count == 0:
            break
    return beam.motions, beam.taken


@kernel
def _poses(n: int, k: int) -> Poses:
    pose, slack, tag = np.empty((n, 3)), np.empty(n), np.empty(n, np.int64)
    return Poses(pose, np.empty((n, k), np.int8), np.empty((n, k), np.int64), slack, tag)


@inlined
def _put(to: Poses, i: int, x: float, y: float, theta: float, status: Int8s, run: Ints) -> None:
    to.pose[i, 0], to.pose[i, 1], to.pose[i, 2] = x, y, theta
    copy_progress(status, run, to.status[i], to.run[i])


@leaf
def _expand(guide: Guide, t: int, n: int, count: int, open_roots: int, beam: Beam, scratch: Scratch) -> int:
    """Makes motions from the first `count` poses of `here`. Writes each new pose once; returns how many."""
    body, rules, tables, _, _ = guide
    here, new, edges, band, every = beam.here, beam.new, beam.edges, beam.terms.band, beam.terms.every
    found, joined, turns_matter = 0, 0, reads_heading(rules.programs, rules.regions)
    beam.table[:] = -1
    for w in range(count):
        edges.tag[n, w] = here.tag[w]
        if here.tag[w] & open_roots == 0:
            continue
        before_x, before_y, before = here.pose[w, 0], here.pose[w, 1], here.pose[w, 2]
        copy_progress(here.status[w], here.run[w], scratch.status, scratch.run)
        some = ((31 * w + n) * 2654435761 >> 16) % every, every  # scattered by Knuth's hash
        cos, sin, room = around(body, before_x, before_y, before)
        corners = score(guide, before_x, before_y, before, t + n, -1, some, scratch)
        lowest = max(band + (t + tables.early) + n + 1, _lowest(scratch.scores))
        read = False  # whether the scratch holds the predicates at the place that the motions begin at
        for m in range(some[0], motion_count(body), some[1]):
            if scratch.scores[m] < lowest:
                continue
            x, y, theta = step_from(body, before_x, before_y, before, cos, sin, room, m)
            copy_progress(here.status[w], here.run[w], scratch.status, scratch.run)
            # A turn does not change the corners, and mostly not the predicates either.
            stays = x == before_x and y == before_y
            if not (stays and read):
                read_due(rules, t + n + 1, x, y, theta, scratch)
                read = stays and not turns_matter
            advance(rules, t + n + 1, scratch.predicates, scratch.status, scratch.run)
            _put(new, found, x, y, theta, scratch.status, scratch.run)
            at = _place(new, found, beam.table)
            if at == found:
                free = (x, y, theta) == unhindered(body, before_x, before_y, before, cos, sin, m)
                if free and corners != UNKNOWN and _goes_on(here, w, scratch):
                    new.slack[at] = scratch.scores[m] - (t + n + 1 + tables.early)
                else:
                    about, known = (scratch.corners, corners) if stays else (scratch.ahead, UNKNOWN)
                    new.slack[at] = slack_at(guide, x, y, theta, t + n + 1, scratch, about, known)
                new.tag[at] = 0
                found += 1
            if new.slack[at] >= band and not is_broken(new.status[at]):
                new.tag[at] |= here.tag[w]
                edges.child[n, joined], edges.parent[n, joined], edges.motion[n, joined] = at, w, m
                joined += 1
    edges.made[n] = joined
    return found


@inlined
def _goes_on(here: Poses, w: int, scratch: Scratch) -> bool:
    """Whether the scratch holds the progress of row `w` of `here`, and no dwell is under way."""
    for k in range(scratch.status.shape[0]):
        if scratch.status[k] != here.status[w, k] or scratch.run[k] > 0 or here.run[w, k] > 0:
            return False
    return True


@leaf
def _lowest(scores: Floats) -> float:
    """The lowest score with which a motion is tried, so that about MAX_TRIED are."""
    if scores.shape[0] <= MAX_TRIED:
        return -np.inf
    best = -np.inf
    for m in range(scores.shape[0]):
        best = max(best, scores[m])
    gap = WIDEST_GAP
    while gap > NARROWEST_GAP:
        count = 0
        for m in range(scores.shape[0]):
            count += scores[m] >= best - gap
        if count <= MAX_TRIED:
            break
        gap *= 0.5
    return best - gap


@leaf
def _finish(t: int, n: int, found: int, open_roots: int, beam: Beam) -> int:
    """Writes the way of every root that has one now; returns the roots that are still open, as bits."""
    new, begun, target = beam.new, beam.begun, beam.terms.target
    for c in range(found):
        arrived = new.tag[c] & open_roots
        ahead = new.slack[c]
        if arrived == 0 or ahead < min(EASY, target - (t + n + 1)):
            continue
        for r in range(begun.shape[0]):
            if arrived >> r & 1 == 0:
                continue
            gained = ahead == SAFE or ahead + (t + n + 1) > target
            for k in range(begun.shape[1]):
                gained = gained or new.status[c, k] != begun[r, k]
            if gained:
                _trace(n, c, r, beam.edges, beam.motions[r])
                beam.taken[r] = n + 1
                open_roots &= ~(1 << r)
    return open_roots


@leaf
def _select(found: int, n: int, open_roots: int, beam: Beam) -> int:
    """Puts the poses to go on with into `here`, most slack first, until each root has its share; returns how
    many there are. found: how many poses `new` has. Removes the edges to poses that are not kept.
    """
    terms, here, new, edges, place, kept = beam.terms, beam.here, beam.new, beam.edges, beam.place, beam.kept
    heap = beam.heap
    for r in range(kept.shape[0]):
        kept[r] = 0
    size = 0
    for o in range(found):
        place[o] = -1
        if new.slack[o] >= terms.band and new.tag[o] & open_roots != 0:
            heap.row[size], heap.rank[size] = o, -new.slack[o]
            size += 1
    for i in range(size // 2 - 1, -1, -1):
        sink(heap, i, size, heap.row[i], heap.rank[i])
    count, full = 0, 0  # full: the roots that have their share
    while size > 0 and count < beam.width:
        o = heap.row[0]
        size -= 1
        sink(heap, 0, size, heap.row[size], heap.rank[size])
        tag = new.tag[o] & open_roots
        if tag & ~full == 0:
            continue
        for r in range(kept.shape[0]):
            kept[r] += tag >> r & 1
            if kept[r] >= terms.share:
                full |= 1 << r
        _put(here, count, new.pose[o, 0], new.pose[o, 1], new.pose[o, 2], new.status[o], new.run[o])
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


@inlined
def _place(new: Poses, found: int, table: Int32s) -> int:
    """The row of `new` whose pose and progress are those of row `found`: an earlier one, or `found` itself,
    which is then put into the hash table.
    """
    x, y, theta = _rounded(new.pose, found)
    key = x * 73856093 ^ y * 19349663 ^ theta * 83492791
    for k in range(new.status.shape[1]):
        key = key * 31 + 4 * new.run[found, k] + new.status[found, k]
    slot = (key ^ key >> 15) & (table.shape[0] - 1)
    while table[slot] >= 0:
        other = table[slot]
        same = _rounded(new.pose, other) == (x, y, theta)
        for k in range(new.status.shape[1]):
            same = same and new.status[found, k] == new.status[other, k]
            same = same and new.run[found, k] == new.run[other, k]
        if same:
            return int(other)
        slot = (slot + 1) & (table.shape[0] - 1)
    table[slot] = found
    return found


@inlined
def _rounded(poses: Floats, i: int) -> tuple[int, int, int]:
    x, y, theta = POSE_GRAIN * poses[i, 0], POSE_GRAIN * poses[i, 1], POSE_GRAIN * poses[i, 2]
    return math.floor(x + 0.5), math.floor(y + 0.5), math.floor(theta + 0.5)


@leaf
def _trace(n: int, at: int, root: int, edges: Edges, motions: Ints) -> None:
    """Writes the motions from a root to pose `at` of step n into motions[:n + 1]."""
    for layer in range(n, -1, -1):
        for e in range(edges.made[layer]):
            if edges.child[layer, e] == at and edges.tag[layer, edges.parent[layer, e]] >> root & 1:
                motions[layer], at = edges.motion[layer, e], edges.parent[layer, e]
                break
