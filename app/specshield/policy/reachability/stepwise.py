"""Feasibility step by step, for a robot that cannot stand still.

What such a robot can do from time t need not be possible from an earlier time, so no single latest time says
it all. With p the progress, which also counts the steps of a dwell, backward over exact steps:

    B(T, s, p) = every goal is settled in p
    B(t, s, p) = for some motion a, with s' = f(s, a) valid at t + 1:  B(t + 1, s', p after s')

valid: free, and the `always` of the step hold. B is one bit. Between the lattice's crossings it is what valid
corners of more than half of the weight say. A move against an obstacle may be how such a robot stands still.

The planner takes such robots too, but finds less (docs/decisions.md).
"""

from __future__ import annotations

import math

import numpy as np

from specshield.arrays import Bools, Bytes, Floats, Int32s, Ints
from specshield.compiled import inlined, kernel, leaf
from specshield.policy.lattice import Lattice, corner
from specshield.policy.progress import ALWAYS, EVENTUALLY_ALWAYS, PENDING, SETTLED, Rules, advance
from specshield.policy.reachability.sight import cells_about
from specshield.policy.reachability.tables import Tables, is_broken, number_of

MAX_BYTES = 100_000_000  # of the tables
BROKEN_STATE = -1


def digits_of(rules: Rules) -> tuple[Ints, Ints]:
    """The progress as one number, sum_k stride_k digit_k: stride and dwell [K].

    An F's digit is 1 once settled. A dwell of n steps counts 0 to n, n + 1 once settled. An `always` has
    stride 0.
    """
    dwell = np.where(rules.kind == EVENTUALLY_ALWAYS, rules.b - rules.c2 + 1, 0)
    values = np.where(rules.kind == ALWAYS, 1, dwell + 2)
    stride = np.concatenate([np.ones(1, np.int64), np.cumprod(values)[:-1]])
    return np.where(rules.kind == ALWAYS, 0, stride), dwell


def state_count(rules: Rules) -> int:
    """How many values the progress can have."""
    _, dwell = digits_of(rules)
    return math.prod(1 if kind == ALWAYS else int(n) + 2 for kind, n in zip(rules.kind, dwell, strict=True))


@kernel
def transitions(rules: Rules, stride: Ints, dwell: Ints, states: int, t: int, holds: int) -> Ints:
    """The progress after step t for each before it (states,), BROKEN_STATE where that breaks the formula.

    stride, dwell: of `digits_of`; holds: bit k says whether obligation k's predicate does.
    """
    count = rules.kind.shape[0]
    status, run, predicates = np.empty(count, np.int8), np.empty(count, np.int64), np.empty(count)
    after = np.empty(states, np.int64)
    for before in range(states):
        for k in range(count):
            digit = before // stride[k] % (dwell[k] + 2) if stride[k] > 0 else 1  # an `always` counts apart
            status[k], run[k] = SETTLED if digit > dwell[k] else PENDING, digit
            predicates[k] = np.inf if holds >> k & 1 else -np.inf
        advance(rules, t, predicates, status, run)
        after[before] = BROKEN_STATE if is_broken(status) else number_of(stride, dwell, status, run)
    return after


def feasible_steps(lattice: Lattice, rules: Rules, holds: Bytes, horizon: int, row: Int32s) -> Bytes:
    """B as bits, uint8 [T + 1, cells, H, ceil(P / 8)].

    holds [K, ny, nx, H]; row [ny, nx]: of each cell in B, -1 for none.
    """
    states, digits = state_count(rules), digits_of(rules)
    used = row >= 0
    held = np.zeros(lattice.valid.shape, np.int64)
    for k in range(len(rules.kind)):
        held |= holds[k].astype(np.int64) << k
    patterns, of = np.unique(held[used], return_inverse=True)
    of = of.reshape(-1, lattice.headings)
    bits = np.zeros((horizon + 1, len(of), lattice.headings, -(-states // 8)), np.uint8)
    valid: Bytes = lattice.valid[used]
    last: Bytes | None = None
    bits[horizon, :, :, (states - 1) >> 3] = np.where(valid, 1 << ((states - 1) & 7), 0)
    for t in range(horizon, -1, -1):
        asked = sum(
            1 << int(k) for k in np.flatnonzero(rules.kind == ALWAYS) if rules.a[k] <= t <= rules.b[k]
        )
        after = np.empty((len(patterns), states), np.int64)
        for n, pattern in enumerate(patterns):
            after[n] = transitions(rules, *digits, states, t, pattern)
        after[(patterns & asked) != asked] = BROKEN_STATE
        before = np.zeros_like(bits[t])
        _before(bits[t], valid, of, after, before)
        if t > 0:
            changed = used
            if last is not None:  # where nothing changed in reach, the motions lead to what they did
                bits[t - 1] = bits[t]
                differs = np.append(np.any(before != last, axis=(1, 2)), False)  # row -1 is no cell
                changed = cells_about(differs[row], lattice.reach + 1)
            _step_back(
                lattice, valid, row, changed, np.bitwise_or.reduce(before, (0, 1)), before, bits[t - 1]
            )
            last = before
    return bits


@kernel
def _before(bits: Bytes, valid: Bytes, pattern: Ints, after: Ints, out: Bytes) -> None:
    """From the progress that includes a step's pose to the one before it: out[p] = bits[after[p]]."""
    states = after.shape[1]
    for c in range(bits.shape[0]):
        for h in range(bits.shape[1]):
            if not valid[c, h]:
                continue
            some = False
            for b in range(bits.shape[2]):
                some = some or bits[c, h, b] != 0
            if not some:
                continue
            for p in range(states):
                to = after[pattern[c, h], p]
                if to >= 0 and bits[c, h, to >> 3] >> (to & 7) & 1:
                    out[c, h, p >> 3] |= 1 << (p & 7)


@kernel
def _step_back(
    lattice: Lattice, valid: Bytes, row: Int32s, changed: Bools, some: Bytes, following: Bytes, out: Bytes
) -> None:
    """out(s) = the union over motions of `following` where they lead, in the cells `changed` [ny, nx].

    some (bytes,): the bits that `following` has anywhere; a pose that has them all needs no more motions.
    """
    ny, nx = row.shape
    headings, size = following.shape[1], following.shape[2]
    at, weight = np.empty(4, np.int64), np.empty(4)
    for j in range(ny):
        for i in range(nx):
            c = row[j, i]
            if c < 0 or not changed[j, i]:
                continue
            for h in range(headings):
                out[c, h] = 0
                if not valid[c, h]:
                    continue
                for r in range(lattice.shift.shape[0]):
                    w = (h + lattice.shift[r]) % headings if lattice.turns[j, i, h, r] else h
                    for b in range(size):
                        out[c, h, b] |= following[c, w, b]
                for d in range(lattice.far_u.shape[3]):
                    if _has_all(out[c, h], some):
                        break
                    u, v = lattice.far_u[j, i, h, d], lattice.far_v[j, i, h, d]
                    if u == np.float32(-1.0):  # contact: it stays
                        for b in range(size):
                            out[c, h, b] |= following[c, h, b]
                        continue
                    w = int(lattice.far_h[j, i, h, d])
                    n = _corners(row, valid, v, u, w, at, weight)
                    for b in range(size):
                        out[c, h, b] |= _majority(following, at, weight, n, w, b)


@inlined
def _has_all(bits: Bytes, some: Bytes) -> bool:
    same = True
    for b in range(bits.shape[0]):
        same = same and bits[b] == some[b]
    return same


@leaf
def _corners(row: Int32s, valid: Bytes, v: float, u: float, h: int, at: Ints, weight: Floats) -> int:
    """The rows of the valid corners about a place of the lattice, with weights that sum to 1; how many."""
    found, total = 0, 0.0
    for n in range(4):
        j, i, w = corner(v, u, n)
        if j < 0 or j >= row.shape[0] or i < 0 or i >= row.shape[1] or w < 1e-6:
            continue
        if row[j, i] >= 0 and valid[row[j, i], h]:
            at[found], weight[found] = row[j, i], w
            total += w
            found += 1
    for k in range(found):
        weight[k] /= total
    return found


@leaf
def _majority(bits: Bytes, at: Ints, weight: Floats, n: int, h: int, b: int) -> int:
    """The bits that corners of more than half of the weight have."""
    common, some = 255, 0
    for k in range(n):
        common &= bits[at[k], h, b]
        some |= bits[at[k], h, b]
    if n == 0 or common == some:
        return some
    result = 0
    for bit in range(8):
        if some >> bit & 1:
            share = 0.0
            for k in range(n):
                if bits[at[k], h, b] >> bit & 1:
                    share += weight[k]
            if share > 0.5:
                result |= 1 << bit
    return result


def step_tables(rules: Rules, horizon: int, cell: Int32s, bits: Bytes, pitch: float) -> Tables:
    """Tables of feasibility step by step from what a file holds of them."""
    code = np.empty((0, *bits.shape[1:3]), np.uint16)
    phase, end = np.zeros(horizon + 1, np.int32), np.array([horizon], np.int32)
    bit = np.zeros(len(rules.kind), np.int64)
    return Tables(
        cell, code, np.full((1, 1), -1, np.int32), phase, end, bit, bits, *digits_of(rules), pitch, 0, 0.0
    )
