"""What the rule will still cost a surrogate of the model: its desirability function, solved backwards.

    D_t(s, p) = c(p) - (1 - e(s)) log sum_a r(a | s) exp(-D_{t+1}(s', p') - L(s'; p, p')),  s' = f(s, a)

r: the surrogate's motions, given that it does not end; e: the chance that it does, after which the rule
costs nothing; p: the goals of the formula that are settled; c: the price of a step while some are not; L: of
the steps that are left to the model's own goal where the last of them is settled, 0 elsewhere. All in nats.
Without prices exp(-D) is the probability that the surrogate itself would keep the rule, and following r
exp(-D) costs D in KL over the whole path: the least there is (Todorov, 2009). On a coarse lattice; the
feasible set keeps the rule, D only orders what is in it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel, leaf
from specshield.lookahead.lattice import Planes
from specshield.policy.lattice import coordinates
from specshield.robot.dynamics import Body, displacement

Singles = NDArray[np.float32]

NEVER = np.float32(1e6)  # D where the rule cannot be kept
TIGHT = np.float32(6.0)  # [nats] what it costs to be where no neighbour of the lattice can: walls, deadlines
CODES = 32.0  # table codes a nat, which reach to 2,047 nats
NO_CODE = 65535


@kernel
def solve(
    body: Body, planes: Planes, motions: Singles, ends: Singles, price: float, left: Singles
) -> NDArray[np.uint16]:
    """D as codes [kept, H, rows].

    motions [M, H, N]: log r; ends [H, N]: e; price: c, a step [nats]; left [N]: L [nats].
    """
    headings, cells = planes.valid.shape
    edge = planes.pad * planes.width + planes.pad
    horizon, sets = planes.slot.shape[0] - 2, planes.slot.shape[1]
    table = np.empty((planes.kept.max() + 1, headings, planes.row.max() + 1), np.uint16)
    following = np.full((sets, headings, cells), NEVER, np.float32)  # D at t + 1
    current = np.full((sets, headings, cells), NEVER, np.float32)
    ahead = np.empty((headings, cells), np.float32)
    inside = cells - 2 * edge
    cost = np.empty((motions.shape[0], inside), np.float32)
    least, total = np.empty(inside, np.float32), np.empty(inside, np.float32)
    for t in range(horizon, -1, -1):
        for mask in range(sets):
            here, slot = current[mask], planes.slot[t, mask]
            here[:] = NEVER
            if slot < 0:
                continue
            due = np.float32(price if mask != sets - 1 else 0.0)
            if t == horizon:
                if mask == sets - 1:
                    here[:] = 0.0
            else:
                _gather(planes, t + 1, mask, following, left, ahead)
                for h in range(headings):
                    _back(body, planes, h, edge, motions, ends, ahead, due, cost, least, total, here)
            _bar(planes.possible[slot] if planes.possible.shape[0] > 0 else planes.valid, here)
            if planes.kept[t, mask] != planes.kept[t + 1, mask]:
                _encode(planes.row, here, table[planes.kept[t, mask]])
        following, current = current, following
    return table


@kernel
def _gather(planes: Planes, t: int, mask: int, following: Singles, left: Singles, ahead: Singles) -> None:
    """D at step t once its own state is taken into the progress, [H, N]."""
    due, opened, last = planes.due[t], planes.open[t] & ~mask, following.shape[0] - 1
    for h in range(ahead.shape[0]):
        row, plain = ahead[h], following[mask, h]
        for c in range(row.shape[0]):
            row[c] = plain[c]
        if due == 0 and opened == 0:
            continue
        holds, keeps = planes.holds[h], planes.keeps[h]
        for c in range(row.shape[0]):
            if keeps[c] & due != due:
                row[c] = NEVER
            elif holds[c] & opened:
                after = mask | (holds[c] & opened)
                row[c] = following[after, h, c] + (left[c] if after == last else np.float32(0.0))


@kernel
def _back(
    body: Body,
    planes: Planes,
    h: int,
    edge: int,
    motions: Singles,
    ends: Singles,
    ahead: Singles,
    due: np.float32,
    cost: Singles,
    least: Singles,
    total: Singles,
    out: Singles,
) -> None:
    """One step back for the poses of heading h. In flat passes over a plane, which compile to vectors."""
    headings, cells = ahead.shape
    last, one = cells - edge, np.float32(1.0)
    least[:] = NEVER
    total[:] = 0.0
    for m in range(motions.shape[0]):
        move, turn = displacement(body, m)
        move, turn = move / planes.pitch, turn * headings / (2.0 * math.pi)
        low = int(np.floor(turn + 1e-6))
        part = np.float32(max(turn - low, 0.0)) if turn - low > 1e-6 else np.float32(0.0)
        g0, g1 = ahead[(h + low) % headings], ahead[(h + low + 1) % headings]
        if move == 0.0:
            _mix(g0[edge:last], g1[edge:last], one - part, part, cost[m])
        else:
            g = g0 if part < 0.5 else g1
            angle = 2.0 * math.pi * h / headings
            du, dv = round(move * math.cos(angle), 6), round(move * math.sin(angle), 6)
            i, j = int(np.floor(du)), int(np.floor(dv))
            p, q = np.float32(du - i), np.float32(dv - j)
            at = edge + j * planes.width + i
            to, up = at + last - edge, planes.width
            _blend(
                g[at:to], g[at + 1 : to + 1], g[at + up : to + up], g[at + up + 1 : to + up + 1],
                (one - q) * (one - p), (one - q) * p, q * (one - p), q * p, cost[m],
            )  # fmt: skip
        _add(planes.free[m, h, edge:last], ahead[h, edge:last], motions[m, h, edge:last], cost[m], least)
    for m in range(motions.shape[0]):
        _sum(cost[m], least, total)
    _close(least, total, ends[h, edge:last], due, out[h, edge:last])


@kernel
def _mix(a: Singles, b: Singles, wa: np.float32, wb: np.float32, out: Singles) -> None:
    zero, one = np.float32(0.0), np.float32(1.0)
    for c in range(out.shape[0]):
        va, vb = wa if a[c] < NEVER else zero, wb if b[c] < NEVER else zero
        weight = va + vb
        value = (va * a[c] + vb * b[c]) / max(weight, np.float32(1e-6)) + TIGHT * (one - weight)
        out[c] = value if weight > np.float32(1e-3) else NEVER


@kernel
def _blend(
    a: Singles,
    b: Singles,
    c: Singles,
    d: Singles,
    wa: np.float32,
    wb: np.float32,
    wc: np.float32,
    wd: np.float32,
    out: Singles,
) -> None:
    """Bilinear over the corners from which the rule can be kept, at a price for the others."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for k in range(out.shape[0]):
        va, vb = wa if a[k] < NEVER else zero, wb if b[k] < NEVER else zero
        vc, vd = wc if c[k] < NEVER else zero, wd if d[k] < NEVER else zero
        weight = va + vb + vc + vd
        value = (va * a[k] + vb * b[k] + vc * c[k] + vd * d[k]) / max(weight, np.float32(1e-6))
        out[k] = value + TIGHT * (one - weight) if weight > np.float32(1e-3) else NEVER


@kernel
def _add(free: Singles, stay: Singles, log_r: Singles, cost: Singles, least: Singles) -> None:
    """D after a motion, from where it is stopped short that of staying, less log r; and the least so far."""
    for c in range(cost.shape[0]):
        value = (cost[c] if free[c] > np.float32(0.0) else stay[c]) - log_r[c]
        cost[c] = value
        least[c] = value if value < least[c] else least[c]


@kernel
def _sum(cost: Singles, least: Singles, total: Singles) -> None:
    """exp(least - cost), as (1 + x / 256)^256: within 2 % where it matters, and it compiles to vectors."""
    for c in range(total.shape[0]):
        x = np.float32(1.0) + (least[c] - cost[c]) * np.float32(1.0 / 256.0)
        x = x if x > np.float32(0.0) else np.float32(0.0)
        x *= x
        x *= x
        x *= x
        x *= x
        x *= x
        x *= x
        x *= x
        x *= x
        total[c] += x


@kernel
def _close(least: Singles, total: Singles, ends: Singles, due: np.float32, out: Singles) -> None:
    for c in range(out.shape[0]):
        y = (total[c] - np.float32(1.0)) / (total[c] + np.float32(1.0))  # log z = 2 artanh((z - 1) / (z + 1))
        s = y * y
        log = y * (np.float32(2.0) + s * (np.float32(2 / 3) + s * (np.float32(0.4) + s * np.float32(2 / 7))))
        value = due + (np.float32(1.0) - ends[c]) * (least[c] - log)
        out[c] = value if least[c] < np.float32(0.5) * NEVER else NEVER


@kernel
def _bar(possible: NDArray[np.uint8], values: Singles) -> None:
    for h in range(possible.shape[0]):
        for c in range(possible.shape[1]):
            if not possible[h, c]:
                values[h, c] = NEVER


@kernel
def _encode(row: NDArray[np.int64], values: Singles, out: NDArray[np.uint16]) -> None:
    top = np.float32((NO_CODE - 1) / CODES)
    for c in range(row.shape[0]):
        if row[c] >= 0:
            for h in range(values.shape[0]):
                value = max(min(values[h, c], top), np.float32(0.0))
                code = np.uint16(value * np.float32(CODES) + np.float32(0.5))
                out[h, row[c]] = np.uint16(NO_CODE) if values[h, c] >= NEVER else code


@leaf
def desirability(
    body: Body, planes: Planes, table: NDArray[np.uint16], t: int, mask: int, x: float, y: float, theta: float
) -> float:
    """D at a pose at step t with the goals of `mask` settled [nats]; NEVER where no corner has any."""
    if mask < 0 or planes.kept[t, mask] < 0:
        return float(NEVER)
    after, before = t, t - 1
    while planes.kept[after + 1, mask] == planes.kept[t, mask]:
        after += 1
    while before >= 0 and planes.kept[before, mask] == planes.kept[t, mask]:
        before -= 1
    later = _at(body, planes, table[planes.kept[t, mask]], x, y, theta)
    if t == after or before < 0 or planes.kept[before, mask] < 0:
        return later
    sooner = _at(body, planes, table[planes.kept[before, mask]], x, y, theta)
    share = (t - before) / (after - before)
    return later if later >= NEVER else share * later + (1.0 - share) * sooner


@leaf
def _at(body: Body, planes: Planes, table: NDArray[np.uint16], x: float, y: float, theta: float) -> float:
    """Bilinear in a table [H, rows]."""
    headings = table.shape[0]
    v, u, h = coordinates(body, planes.pitch, headings, x, y, theta)
    j, i, low = int(np.floor(v)), int(np.floor(u)), int(np.floor(h))
    q, p, f = v - j, u - i, h - low
    total, weights = 0.0, 0.0
    for dj in range(2):
        for di in range(2):
            c = (j + dj + planes.pad) * planes.width + i + di + planes.pad
            if c < 0 or c >= planes.row.shape[0] or planes.row[c] < 0:
                continue
            for dh in range(2):
                w = (q if dj else 1.0 - q) * (p if di else 1.0 - p) * (f if dh else 1.0 - f)
                code = table[(low + dh) % headings, planes.row[c]]
                if w > 1e-6 and code != NO_CODE:
                    total += w * code / CODES
                    weights += w
    return float(total / weights + TIGHT * (1.0 - weights)) if weights > 1e-3 else float(NEVER)
