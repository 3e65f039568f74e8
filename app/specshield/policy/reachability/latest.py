"""The latest feasible time: one number a pose and progress from which a formula can still be satisfied.

Where the robot can wait, and as long as no `always` begins or ends, feasibility is monotone in time: what can
be done from time t can be done from any earlier time, by waiting. So time falls into phases, in each of which
the same `always` hold. In each phase, with p the set of settled goals,

    L(s, p) = max( max_a L(f(s, a), p) - 1,
                   max_J m(s, p, J),
                   the phase's end, if the next phase can be entered from s )

m(s, p, J) is the latest time from which waiting at s settles all of the goals J and leaves L(s, p + J) ahead.
For F[a,b] that is at most b, and L >= a has to hold. For F[a,c1] G[c2,b], a dwell of n = b - c2 + 1 steps, it
is at most c1 + c2 and L - n + 1, and L >= a + b has to hold. This is backward dynamic programming by in-place
semi-Lagrangian sweeps, bilinear between the lattice's crossings.

Off the lattice L is only nearly right, by how much depends on the robot's motions, the pitch and the map. So
it is measured for each table (`lateness`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bytes, Codes, Floats, Int8s, Int32s, Ints, Singles
from specshield.compiled import Boxed, box, kernel, leaf
from specshield.policy.lattice import INVALID, NO_TIME, STEP_CODES, Lattice, bilinear, number_cells
from specshield.policy.progress import ALWAYS, EVENTUALLY_ALWAYS, PENDING, SETTLED, Rules, goals_of
from specshield.policy.reachability.beam import MAX_SCORED, Terms, beam_search
from specshield.policy.reachability.guide import copy_progress, make_scratch
from specshield.policy.reachability.tables import LATE, Guide, Tables, guided, slack
from specshield.robot.dynamics import motion_count

SETTLED_CHANGE = 0.02  # [steps] a sweep that changes less than this has converged (chosen by hand)
MAX_SWEEPS = 100_000  # far more than any map needs; it only bounds the loop
LEAST_LATE, MOST_LATE = -2, -6  # [steps] what `lateness` finds at least and at most
HARDLY = 0.01  # no way is looked for where at most this share of the beams finds one; chosen by hand


def masks_of(rules: Rules) -> list[int]:
    """The sets of settled goals (bit g for the gth) that some trajectory can have, the fullest first.

    j cannot be settled before k where j's window begins after k's ends.
    """
    goals = goals_of(rules)
    earliest = rules.a + np.where(rules.kind == EVENTUALLY_ALWAYS, rules.b, 0)
    possible = []
    for mask in range(1 << len(goals)):
        missing = [goals[g] for g in range(len(goals)) if not mask >> g & 1]
        have = [goals[g] for g in range(len(goals)) if mask >> g & 1]
        if all(earliest[j] <= rules.last[k] for j in have for k in missing):
            possible.append(mask)
    return sorted(possible, key=lambda m: -m.bit_count())


class Phase(NamedTuple):
    """Steps `start` to `end`, in which the same `always` (indices) hold."""

    start: int
    end: int
    always: tuple[int, ...]


def phases_of(rules: Rules, horizon: int) -> tuple[Phase, ...]:
    """The phases of [0, horizon], in order."""

    def holding(t: int) -> tuple[int, ...]:
        return tuple(
            k for k in np.flatnonzero(rules.kind == ALWAYS).tolist() if rules.a[k] <= t <= rules.b[k]
        )

    starts = [t for t in range(horizon + 1) if t == 0 or holding(t) != holding(t - 1)]
    ends = [*(t - 1 for t in starts[1:]), horizon]
    return tuple(Phase(start, end, holding(start)) for start, end in zip(starts, ends, strict=True))


def latest_times(
    lattice: Lattice, rules: Rules, holds: Bytes, masks: list[int], phases: tuple[Phase, ...]
) -> tuple[Singles, Bytes]:
    """L for each phase and mask, [phases, masks, ny, nx, H], NO_TIME where the phase has none.

    Also where a pose is free and keeps the phase's `always`, [phases, ny, nx, H].
    """
    goals = goals_of(rules)
    index = {mask: n for n, mask in enumerate(masks)}
    tables = np.full((len(phases), len(masks), *lattice.valid.shape), NO_TIME, np.float32)
    valid = np.stack([lattice.valid & np.all(holds[list(phase.always)], axis=0) for phase in phases])
    for i in reversed(range(len(phases))):
        phase = phases[i]
        for mask in masks:
            table = tables[i, index[mask]]
            if i + 1 < len(phases):
                following = phases[i + 1].start
                _enter(lattice, valid[i + 1], tables[i + 1, index[mask]], following, table)
            elif mask == masks[0]:
                table[:] = phase.end
            for after in masks:
                if after & mask == mask and after != mask:
                    added = np.array([g for n, g in enumerate(goals) if (after ^ mask) >> n & 1])
                    _settle(rules, holds, added, tables[i, index[after]], phase.start, table)
                    if np.any(rules.kind[added] == EVENTUALLY_ALWAYS):
                        through = np.ones_like(lattice.valid)
                        for j in range(i + 1, len(phases)):  # a dwell that goes on in a later phase
                            through &= valid[j]
                            later = np.where(through, tables[j, index[after]], np.float32(NO_TIME))
                            _settle(rules, holds, added, later, phases[j].start, table)
            table[table > phase.end] = phase.end
            table[(table < phase.start) | (valid[i] == 0)] = NO_TIME
            if i + 1 < len(phases) or mask != masks[0]:  # elsewhere nothing is left to do
                sweep(lattice, valid[i], float(phase.start), table)
    return tables, valid


@leaf
def _moved(lattice: Lattice, valid: Bytes, table: Singles, j: int, i: int, h: int) -> float:
    """The latest time in a table [ny, nx, H] where the moves from a pose lead, NO_TIME if there is none."""
    best = NO_TIME
    for d in range(lattice.far_u.shape[3]):
        u, v = lattice.far_u[j, i, h, d], lattice.far_v[j, i, h, d]
        if u != np.float32(-1.0):
            best = max(best, bilinear(valid, table, v, u, lattice.far_h[j, i, h, d]))
    return best


@kernel
def _enter(lattice: Lattice, valid: Bytes, following: Singles, start: int, table: Singles) -> None:
    """Writes the last step before the next phase's `start` into `table`, wherever some motion leads to a pose
    that is feasible at that start.
    """
    ny, nx, headings = table.shape
    for j in range(ny):
        for i in range(nx):
            for h in range(headings):
                best = following[j, i, h] if valid[j, i, h] else np.float32(NO_TIME)
                best = max(best, np.float32(_moved(lattice, valid, following, j, i, h)))
                for r in range(lattice.shift.shape[0]):
                    w = (h + lattice.shift[r]) % headings
                    if lattice.turns[j, i, h, r] and valid[j, i, w]:
                        best = max(best, following[j, i, w])
                if best >= start:
                    table[j, i, h] = start - 1


def _settle(rules: Rules, holds: Bytes, added: Ints, ahead: Singles, start: int, table: Singles) -> None:
    """Writes m(s, p, J) into `table` where it is later. added: J; ahead: L(., p + J) from step `start` on."""
    latest, possible = ahead, np.ones(ahead.shape, np.bool_)
    for k in added:
        if rules.kind[k] == EVENTUALLY_ALWAYS:
            over, by = rules.a[k] + rules.b[k], np.float32(rules.c1[k] + rules.c2[k])
            latest = np.minimum(latest, np.minimum(by, ahead - np.float32(rules.b[k] - rules.c2[k])))
        else:
            over, by = rules.a[k], np.float32(rules.b[k])
            latest = np.minimum(latest, by)
            possible &= start <= rules.b[k]
        possible &= (holds[k] == 1) & (ahead >= max(start, over))
    np.maximum(table, np.where(possible, latest, np.float32(NO_TIME)), out=table)


@kernel
def sweep(lattice: Lattice, valid: Bytes, start: float, table: Singles) -> None:
    """Relaxes L(s) = max_a L(f(s, a)) - 1 in place to its fixed point; visits only cells near what changed.

    start: the phase's first step; no L is earlier.
    """
    ny, nx, headings = table.shape
    reach = lattice.reach
    active = np.zeros((ny, nx), np.uint8)
    for j in range(ny):
        for i in range(nx):
            for h in range(headings):
                if table[j, i, h] >= 0.0:
                    active[max(j - reach, 0) : j + reach + 1, max(i - reach, 0) : i + reach + 1] = 1
                    break
    for sweep in range(MAX_SWEEPS):
        changed = False
        for jj in range(ny):
            j = jj if sweep & 1 else ny - 1 - jj
            for ii in range(nx):
                i = ii if sweep & 2 else nx - 1 - ii
                if not active[j, i]:
                    continue
                active[j, i] = 0
                gained = False
                for h in range(headings):
                    if not valid[j, i, h]:
                        continue
                    best = np.float32(_moved(lattice, valid, table, j, i, h) - 1.0)
                    if best > table[j, i, h] + SETTLED_CHANGE and best >= start:
                        table[j, i, h] = best
                        gained = True
                turned = True
                while turned:
                    turned = False
                    for h in range(headings):
                        if not valid[j, i, h]:
                            continue
                        for r in range(lattice.shift.shape[0]):
                            if lattice.turns[j, i, h, r]:
                                found = table[j, i, (h + lattice.shift[r]) % headings] - np.float32(1.0)
                                if found > table[j, i, h] + SETTLED_CHANGE and found >= start:
                                    table[j, i, h] = found
                                    turned = gained = True
                if gained:
                    changed = True
                    active[max(j - reach, 0) : j + reach + 1, max(i - reach, 0) : i + reach + 1] = 1
        if not changed:
            return


def pack_times(
    latest: Singles, valid: Bytes, masks: list[int], phases: tuple[Phase, ...], rules: Rules, pitch: float
) -> Tables:
    """The latest times of `latest_times` as tables."""
    used = np.any(valid, axis=(0, 3))
    table = np.full((len(phases), 1 << len(goals_of(rules))), -1, np.int32)
    codes: list[Codes] = []
    for i in range(len(phases)):
        for n, mask in enumerate(masks):
            values = latest[i, n][used]
            settled = mask == masks[0] and i == len(phases) - 1  # nothing left to do
            if settled or not np.any(values >= 0.0):
                continue
            code = np.where(values >= 0.0, 1.0 + np.floor(STEP_CODES * values), 0.0).astype(np.uint16)
            code[valid[i][used] == 0] = INVALID
            table[i, mask] = len(codes)
            codes.append(code)
    code = np.array(codes, np.uint16).reshape(len(codes), int(used.sum()), valid.shape[3])
    return time_tables(rules, phases, number_cells(used), code, table, pitch)


def time_tables(
    rules: Rules, phases: tuple[Phase, ...], cell: Int32s, code: Codes, table: Int32s, pitch: float
) -> Tables:
    """Tables of latest times from what a file holds of them."""
    bit, goals = np.zeros(len(rules.kind), np.int64), goals_of(rules)
    bit[goals] = 1 << np.arange(len(goals))
    ends = np.array([phase.end for phase in phases], np.int32)
    phase = np.searchsorted(ends, np.arange(ends[-1] + 1)).astype(np.int32)
    none, steps = np.empty((0, 0, 0, 0), np.uint8), (np.zeros_like(bit), np.zeros_like(bit))
    return Tables(cell, code, table, phase, ends, bit, none, *steps, pitch, 0, LATE)


def lateness(guide: Guide, width: int, poses: Floats) -> float:
    """The slack [steps], LEAST_LATE to MOST_LATE, below which a beam hardly ever finds a way: `Tables.late`.

    guide: of the tables; width: of a decision's beams; poses [N, 3]: drawn over free space. For each pose a
    set of settled goals is drawn, and a step at which it has up to one step of slack less.
    """
    sets = np.array(masks_of(guide.rules), np.int64)
    drawn = np.random.default_rng(0).integers(len(sets), size=len(poses))
    done = (sets[drawn, None] & guide.tables.bit != 0).astype(np.int8)
    status = np.where(done, SETTLED, PENDING).astype(np.int8)
    for late in range(LEAST_LATE, MOST_LATE, -1):
        if not _finds_ways(box(guide), width, float(late), poses, status):
            return float(late)
    return float(MOST_LATE)


@kernel
def _finds_ways(boxed: Boxed[Guide], width: int, late: float, poses: Floats, status: Int8s) -> bool:
    """Whether more than HARDLY beams find a way from poses (N, 3) with the progress `status` (N, K), each at
    the first step at which the slack is from `late` - 1 to `late` [steps], if there is one.
    """
    guide = guided(boxed, 0.0)
    tables, horizon, motions = guide.tables, guide.tables.end[-1], motion_count(guide.body)
    scratch, every = make_scratch(guide.rules, motions), 1 + (motions - 1) // MAX_SCORED
    tried, found = 0, 0
    run = np.zeros((1, status.shape[1]), np.int64)
    terms = Terms(width, late - 1.0, np.inf, every)
    for n in range(poses.shape[0]):
        copy_progress(status[n], run[0], scratch.status, scratch.run)
        start = 0
        for end in tables.end:
            ahead = slack(guide, poses[n, 0], poses[n, 1], poses[n, 2], start, scratch)
            t = start + int(np.floor(ahead - late)) + 1
            if start <= t <= end and t < horizon:
                here, own = poses[n : n + 1], status[n : n + 1]
                _, taken = beam_search(guide, t, here, own, run, horizon - t, terms, scratch)
                tried, found = tried + 1, found + (taken[0] > 0)
                break
            start = end + 1
        if found > HARDLY * poses.shape[0]:
            break
    return bool(found > HARDLY * tried)
