"""What the rule will still cost a stand-in of the model: its desirability function D, solved backwards.

    D_t(s, p) = c(p) - (1 - e(s)) log sum_a r(a | s) exp(-D_{t+1}(s', p') - L(s'; p, p')),  s' = f(s, a)

s is a pose, and p the set of the formula's goals that are settled. r: the stand-in's motions, given that it
does not end; e: the chance that it ends, after which the rule costs nothing; c: the price of a step while
some goal is not settled; L: the price of the steps that are left to the stand-in's own goal, where the last
goal of the formula is settled, and 0 elsewhere. All are in nats.

Without prices exp(-D) is the probability that the stand-in keeps the rule by itself, and following r exp(-D)
costs D in KL over the whole path, which is the least possible (Todorov, 2009). D is solved on a coarse
lattice. It only orders what is in the feasible set, which alone keeps the rule.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bytes, Codes, Ints, Singles, copy_row
from specshield.compiled import kernel, leaf
from specshield.lookahead.lattice import Planes
from specshield.lookahead.surrogate import StandIn
from specshield.policy.lattice import coordinates, corner
from specshield.robot.dynamics import displacement

UNKEEPABLE = np.float32(1e6)  # D where the rule cannot be kept
# [nats] The price of corners from which the rule cannot be kept, beside others. By hand, nothing measured.
TIGHT = np.float32(6.0)
CODES = 32.0  # table codes a nat, which reach to 2,047 nats
NO_CODE = 65535


class Sums(NamedTuple):
    """Scratch of one step back over n cells: cost [M, n] of each motion; least and total [n] of all."""

    cost: Singles
    least: Singles
    total: Singles


@kernel
def solve(planes: Planes, stand_in: StandIn) -> Codes:
    """D as codes [kept, H, rows]."""
    headings, cells = planes.valid.shape
    horizon, sets = planes.slot.shape[0] - 2, planes.slot.shape[1]
    table = np.empty((planes.kept.max() + 1, headings, planes.row.max() + 1), np.uint16)
    following = np.full((sets, headings, cells), UNKEEPABLE, np.float32)  # D at t + 1
    current = np.full((sets, headings, cells), UNKEEPABLE, np.float32)
    ahead = np.empty((headings, cells), np.float32)
    inside = cells - 2 * _edge(planes)
    cost = np.empty((stand_in.motions.shape[0], inside), np.float32)
    sums = Sums(cost, np.empty(inside, np.float32), np.empty(inside, np.float32))
    for t in range(horizon, -1, -1):
        for mask in range(sets):
            here, slot = current[mask], planes.slot[t, mask]
            here[:] = UNKEEPABLE
            if slot < 0:
                continue
            price = np.float32(stand_in.price if mask != sets - 1 else 0.0)
            if t == horizon:
                if mask == sets - 1:
                    here[:] = 0.0
            else:
                _gather(planes, t + 1, mask, following, stand_in.left, ahead)
                for h in range(headings):
                    _back(planes, stand_in, h, ahead, price, sums, here)
            _rule_out(planes.possible[slot] if planes.possible.shape[0] > 0 else planes.valid, here)
            if planes.kept[t, mask] != planes.kept[t + 1, mask]:
                _encode(planes.row, here, table[planes.kept[t, mask]])
        following, current = current, following
    return table


@leaf
def _edge(planes: Planes) -> int:
    """How many cells at either end of a plane are padding that no motion is worked out for."""
    return planes.pad * planes.width + planes.pad


@kernel
def _gather(planes: Planes, t: int, mask: int, following: Singles, left: Singles, ahead: Singles) -> None:
    """D at step t once its own state is taken into the progress, [H, N]."""
    due, opened, last = planes.due[t], planes.open[t] & ~mask, following.shape[0] - 1
    for h in range(ahead.shape[0]):
        row, plain = ahead[h], following[mask, h]
        copy_row(plain, row)
        if due == 0 and opened == 0:
            continue
        holds, keeps = planes.holds[h], planes.keeps[h]
        for c in range(row.shape[0]):
            if keeps[c] & due != due:
                row[c] = UNKEEPABLE
            elif holds[c] & opened:
                after = mask | (holds[c] & opened)
                row[c] = following[after, h, c] + (left[c] if after == last else np.float32(0.0))


@kernel
def _back(
    planes: Planes, stand_in: StandIn, h: int, ahead: Singles, price: np.float32, sums: Sums, out: Singles
) -> None:
    """One step back for the poses of heading h, in flat passes over a plane, which compile to vectors.

    ahead [H, N]: D at the next step; price: of this one; out [H, N].
    """
    cost, least, total = sums
    (headings, cells), edge = ahead.shape, _edge(planes)
    last = cells - edge
    least[:] = UNKEEPABLE
    total[:] = 0.0
    for m in range(cost.shape[0]):
        move, turn = displacement(planes.body, m)
        move, turn = move / planes.pitch, turn * headings / (2.0 * math.pi)
        low = int(np.floor(turn + 1e-6))
        part = np.float32(max(turn - low, 0.0)) if turn - low > 1e-6 else np.float32(0.0)
        g0, g1 = ahead[(h + low) % headings], ahead[(h + low + 1) % headings]
        if move == 0.0:  # between two headings of the same cell
            _mix(g0[edge:last], g1[edge:last], part, cost[m])
        else:  # between four cells of the nearest heading
            g = g0 if part < 0.5 else g1
            angle = 2.0 * math.pi * h / headings
            du, dv = round(move * math.cos(angle), 6), round(move * math.sin(angle), 6)
            i, j = int(np.floor(du)), int(np.floor(dv))
            p, q = np.float32(du - i), np.float32(dv - j)
            _blend(g, edge + j * planes.width + i, planes.width, p, q, cost[m])
        log_r = stand_in.motions[m, h, edge:last]
        _charge(planes.free[m, h, edge:last], ahead[h, edge:last], log_r, cost[m], least)
    for m in range(cost.shape[0]):
        _accumulate(cost[m], least, total)
    _sum_up(least, total, stand_in.ends[h, edge:last], price, out[h, edge:last])


@kernel
def _mix(a: Singles, b: Singles, part: np.float32, out: Singles) -> None:
    """As `_blend`, between two, in two thirds of the time: most motions turn. part: the share of b."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for c in range(out.shape[0]):
        va, vb = one - part if a[c] < UNKEEPABLE else zero, part if b[c] < UNKEEPABLE else zero
        weight = va + vb
        value = (va * a[c] + vb * b[c]) / max(weight, np.float32(1e-6)) + TIGHT * (one - weight)
        out[c] = value if weight > np.float32(1e-3) else UNKEEPABLE


@kernel
def _blend(g: Singles, at: int, width: int, p: np.float32, q: np.float32, out: Singles) -> None:
    """Bilinear over the corners from which the rule can be kept, at a price for the others.

    at: the first cell of the lower left corners; width: cells of a row. p, q: the shares of the right and of
    the upper corners.
    """
    zero, one, n = np.float32(0.0), np.float32(1.0), out.shape[0]
    a, b = g[at : at + n], g[at + 1 : at + 1 + n]
    c, d = g[at + width : at + width + n], g[at + width + 1 : at + width + 1 + n]
    wa, wb, wc, wd = (one - q) * (one - p), (one - q) * p, q * (one - p), q * p
    for k in range(out.shape[0]):
        va, vb = wa if a[k] < UNKEEPABLE else zero, wb if b[k] < UNKEEPABLE else zero
        vc, vd = wc if c[k] < UNKEEPABLE else zero, wd if d[k] < UNKEEPABLE else zero
        weight = va + vb + vc + vd
        value = (va * a[k] + vb * b[k] + vc * c[k] + vd * d[k]) / max(weight, np.float32(1e-6))
        out[k] = value + TIGHT * (one - weight) if weight > np.float32(1e-3) else UNKEEPABLE


@kernel
def _charge(free: Singles, stay: Singles, log_r: Singles, cost: Singles, least: Singles) -> None:
    """Replaces D after a motion, in `cost`, by D - log r, and updates the least of all motions so far. A
    motion that is stopped short leaves the robot where it is, where D is `stay`.
    """
    for c in range(cost.shape[0]):
        value = (cost[c] if free[c] > np.float32(0.0) else stay[c]) - log_r[c]
        cost[c] = value
        least[c] = value if value < least[c] else least[c]


@kernel
def _accumulate(cost: Singles, least: Singles, total: Singles) -> None:
    """Adds exp(least - cost) to the total, as (1 + x / 256)^256: within 2 % for x from -3 to 0, and it
    compiles to vectors.
    """
    for c in range(total.shape[0]):
        x = np.float32(1.0) + (least[c] - cost[c]) * np.float32(1.0 / 256.0)
        x = x if x > np.float32(0.0) else np.float32(0.0)
        for _ in range(8):
            x *= x
        total[c] += x


@kernel
def _sum_up(least: Singles, total: Singles, ends: Singles, price: np.float32, out: Singles) -> None:
    """D from the sum over the motions. The logarithm of the total, which is from 1 to M, by its series."""
    for c in range(out.shape[0]):
        y = (total[c] - np.float32(1.0)) / (total[c] + np.float32(1.0))  # log z = 2 artanh((z - 1) / (z + 1))
        s = y * y
        log = y * (np.float32(2.0) + s * (np.float32(2 / 3) + s * (np.float32(0.4) + s * np.float32(2 / 7))))
        value = price + (np.float32(1.0) - ends[c]) * (least[c] - log)
        out[c] = value if least[c] < np.float32(0.5) * UNKEEPABLE else UNKEEPABLE


@kernel
def _rule_out(possible: Bytes, values: Singles) -> None:
    for h in range(possible.shape[0]):
        for c in range(possible.shape[1]):
            if not possible[h, c]:
                values[h, c] = UNKEEPABLE


@kernel
def _encode(row: Ints, values: Singles, out: Codes) -> None:
    top = np.float32((NO_CODE - 1) / CODES)
    for c in range(row.shape[0]):
        if row[c] >= 0:
            for h in range(values.shape[0]):
                value = max(min(values[h, c], top), np.float32(0.0))
                code = np.uint16(value * np.float32(CODES) + np.float32(0.5))
                out[h, row[c]] = np.uint16(NO_CODE) if values[h, c] >= UNKEEPABLE else code


@leaf
def desirability(planes: Planes, table: Codes, t: int, mask: int, x: float, y: float, theta: float) -> float:
    """D at a pose at step t with the goals of `mask` settled [nats]; UNKEEPABLE where no corner has any."""
    if mask < 0 or planes.kept[t, mask] < 0:
        return float(UNKEEPABLE)
    after, before = t, t - 1
    while planes.kept[after + 1, mask] == planes.kept[t, mask]:
        after += 1
    while before >= 0 and planes.kept[before, mask] == planes.kept[t, mask]:
        before -= 1
    later = _at(planes, table[planes.kept[t, mask]], x, y, theta)
    if t == after or before < 0 or planes.kept[before, mask] < 0:
        return later
    sooner = _at(planes, table[planes.kept[before, mask]], x, y, theta)
    share = (t - before) / (after - before)
    return later if later >= UNKEEPABLE else share * later + (1.0 - share) * sooner


@leaf
def _at(planes: Planes, table: Codes, x: float, y: float, theta: float) -> float:
    """Bilinear in a table [H, rows]."""
    headings = table.shape[0]
    v, u, h = coordinates(planes.body, planes.pitch, headings, x, y, theta)
    low = int(np.floor(h))
    f, total, weights = h - low, 0.0, 0.0
    for n in range(4):
        j, i, across = corner(v, u, n)
        c = (j + planes.pad) * planes.width + i + planes.pad
        if c < 0 or c >= planes.row.shape[0] or planes.row[c] < 0:
            continue
        for dh in range(2):
            w = across * (f if dh else 1.0 - f)
            code = table[(low + dh) % headings, planes.row[c]]
            if w > 1e-6 and code != NO_CODE:
                total += w * code / CODES
                weights += w
    return float(total / weights + TIGHT * (1.0 - weights)) if weights > 1e-3 else float(UNKEEPABLE)
