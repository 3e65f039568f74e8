"""Contact between a circular footprint and the occupied squares of a grid, exactly.

A move sweeps the disc along its straight path against each occupied square, so that no move jumps a thin
wall. A turn sweeps the centre of an off-centre footprint along an arc, against which each occupied square is
tested, and is all or nothing. From inside an obstacle the robot may do whatever does not lead deeper into it.

Points are in grid metres: along the columns (u) and rows (v) from the grid's lower-left corner.
"""

from __future__ import annotations

import math

import numpy as np

from specshield.compiled import inlined, leaf
from specshield.robot.body import Body, centre, in_grid

TOUCH = 1e-6  # [m] a footprint that overlaps by less than this is not in collision (poses travel as text)
SKIN = 1e-7  # [m] how far before the first contact a stopped move ends
ROUNDING = 1e-9  # [m] slack against rounding: sliding along a wall is not a contact
CHORD = math.radians(6.0)  # [rad] between the places of a turn at which depths inside obstacles are compared
MAX_DEPTH = 32  # [cells] places deeper inside obstacles count as this deep


@inlined
def _is_occupied(body: Body, row: int, col: int) -> bool:
    if row < 0 or col < 0 or row >= body.occupied.shape[0] or col >= body.occupied.shape[1]:
        return True
    return bool(body.occupied[row, col] != 0)


@inlined
def _cell(body: Body, u: float, v: float) -> tuple[int, int]:
    """Row and column of a point (grid metres). Points off the map get a cell of the ring around it."""
    h, (height, width) = body.resolution, body.occupied.shape
    return math.floor(min(max(v / h, -1.0), height)), math.floor(min(max(u / h, -1.0), width))


@inlined
def _span(body: Body, low: float, high: float, cells: int) -> tuple[int, int]:
    """The range of rows or columns, `cells` of them, between two places (grid metres), with the ring that
    stands for the outside.
    """
    h = body.resolution
    return max(math.floor(low / h), -1), min(math.floor(high / h), cells) + 1


@inlined
def room_around(body: Body, u: float, v: float) -> float:
    """How far around a point (grid metres) the clearance alone shows free space [m]; -inf in an obstacle."""
    h = body.resolution
    row, col = _cell(body, u, v)
    if _is_occupied(body, row, col):
        return -np.inf
    return float(body.clearance[row, col] - math.hypot(u - (col + 0.5) * h, v - (row + 0.5) * h))


@inlined
def free_distance(body: Body, u: float, v: float, limit: float) -> float:
    """Exact distance [m] from a point (grid metres) to the nearest occupied square, at most `limit`."""
    h = body.resolution
    row, col = _cell(body, u, v)
    if _is_occupied(body, row, col):
        return 0.0
    if room_around(body, u, v) >= limit:
        return limit
    best = limit * limit
    first, last = _span(body, u - limit, u + limit, body.occupied.shape[1])
    for j in range(*_span(body, v - limit, v + limit, body.occupied.shape[0])):
        dy = max(j * h - v, 0.0, v - (j + 1) * h)
        if dy * dy >= best:
            continue
        for i in range(first, last):
            dx = max(i * h - u, 0.0, u - (i + 1) * h)
            if dx * dx + dy * dy < best and _is_occupied(body, j, i):
                best = dx * dx + dy * dy
    return math.sqrt(best)


@leaf
def _depth(body: Body, u: float, v: float) -> float:
    """How far inside occupied space a point lies [m]: to the nearest free square, MAX_DEPTH cells at most."""
    h, (height, width) = body.resolution, body.occupied.shape
    most = MAX_DEPTH * h
    if max(-u, u - width * h, -v, v - height * h) >= most:  # so far off the map
        return most
    row, col = _cell(body, u, v)
    half = 4
    while True:  # a window that grows until nothing outside it can be nearer
        best = half * h
        for j in range(max(row - half, 0), min(row + half + 1, height)):
            dy = max(j * h - v, 0.0, v - (j + 1) * h)
            for i in range(max(col - half, 0), min(col + half + 1, width)):
                if body.occupied[j, i] == 0:
                    best = min(best, math.hypot(max(i * h - u, 0.0, u - (i + 1) * h), dy))
        if best < half * h or half >= MAX_DEPTH:
            return best
        half *= 2


@leaf
def _enters_slab(p: float, d: float, low: float, high: float) -> tuple[float, float]:
    """The parameters at which p + s d enters and leaves (low, high)."""
    if d == 0.0:
        if low < p < high:
            return -np.inf, np.inf
        return np.inf, -np.inf
    first, last = (low - p) / d, (high - p) / d
    return min(first, last), max(first, last)


@leaf
def _enters_box(
    pu: float, pv: float, du: float, dv: float, u0: float, u1: float, v0: float, v1: float
) -> float:
    """The least s >= 0 at which p + s d is inside the box (u0, u1) x (v0, v1), inf for none."""
    a0, a1 = _enters_slab(pu, du, u0, u1)
    b0, b1 = _enters_slab(pv, dv, v0, v1)
    enter, leave = max(a0, b0), min(a1, b1)
    if enter < leave and leave > 0.0:
        return max(enter, 0.0)
    return np.inf


@leaf
def _enters_disc(pu: float, pv: float, du: float, dv: float, cu: float, cv: float, r: float) -> float:
    """The least s >= 0 at which p + s d is inside the disc about (cu, cv), inf for none; d of length 1."""
    qu, qv = pu - cu, pv - cv
    along = qu * du + qv * dv
    gap = qu * qu + qv * qv - r * r
    root = along * along - gap
    if root <= 0.0:
        return np.inf
    leave = -along + math.sqrt(root)
    if leave <= 0.0:
        return np.inf
    return max(-along - math.sqrt(root), 0.0)


@inlined
def _first_contact(body: Body, u: float, v: float, du: float, dv: float, length: float, r: float) -> float:
    """How far [m] a disc of radius r moves from (u, v) along a unit vector until it overlaps; inf: never."""
    h = body.resolution
    mu, mv = u + 0.5 * length * du, v + 0.5 * length * dv
    if room_around(body, mu, mv) >= r + 0.5 * length:
        return np.inf
    eu, ev = u + length * du, v + length * dv
    left, right = _span(body, min(u, eu) - r, max(u, eu) + r, body.occupied.shape[1])
    first, reach = np.inf, r + 0.7072 * h  # to the centre of a square that the disc may touch
    for j in range(*_span(body, min(v, ev) - r, max(v, ev) + r, body.occupied.shape[0])):
        for i in range(left, right):
            if not _is_occupied(body, j, i):
                continue
            su, sv = (i + 0.5) * h - u, (j + 0.5) * h - v  # most are out of reach: the exact test is dear
            nearest = min(max(su * du + sv * dv, 0.0), length)
            if (su - nearest * du) ** 2 + (sv - nearest * dv) ** 2 > reach * reach:
                continue
            u0, u1, v0, v1 = i * h, (i + 1) * h, j * h, (j + 1) * h
            # A disc meets a square where its centre meets the square grown by r: two boxes and four discs.
            first = min(first, _enters_box(u, v, du, dv, u0 - r, u1 + r, v0, v1))
            first = min(first, _enters_box(u, v, du, dv, u0, u1, v0 - r, v1 + r))
            first = min(first, _enters_disc(u, v, du, dv, u0, v0, r), _enters_disc(u, v, du, dv, u1, v0, r))
            first = min(first, _enters_disc(u, v, du, dv, u0, v1, r), _enters_disc(u, v, du, dv, u1, v1, r))
    return first if first < length else np.inf


@leaf
def way_ahead(body: Body, x: float, y: float, theta: float, distance: float) -> float:
    """How far of `distance` [m, signed] the robot can go straight on: all of it, or up to the contact."""
    u, v = centre(body, x, y, theta)
    sign = 1.0 if distance > 0.0 else -1.0
    length = abs(distance)
    cx, cy = sign * math.cos(theta), sign * math.sin(theta)
    du, dv = body.cos_yaw * cx + body.sin_yaw * cy, body.cos_yaw * cy - body.sin_yaw * cx
    if room_around(body, u, v) >= body.radius + length:
        return distance
    gap = free_distance(body, u, v, body.radius)
    if gap == 0.0:
        return sign * _escape(body, u, v, du, dv, length)
    # The radius tested is at most the present gap: what overlaps already may slide or leave, not go deeper.
    r = max(min(body.radius - ROUNDING, gap - 1e-12), 0.0)
    contact = _first_contact(body, u, v, du, dv, length, r)
    if contact == np.inf:
        return distance
    return sign * max(contact - SKIN, 0.0)


@leaf
def _escape(body: Body, u: float, v: float, du: float, dv: float, length: float) -> float:
    """From a centre inside an obstacle: as far as the way leads no deeper [m], by steps of a quarter cell."""
    n = math.ceil(length / (0.25 * body.resolution))
    depth = _depth(body, u, v)
    for k in range(1, n + 1):
        s = length * k / n
        deeper = _depth(body, u + s * du, v + s * dv)
        if deeper > depth + ROUNDING:
            return length * (k - 1) / n
        depth = min(depth, deeper)
    return length


@inlined
def _arc_contact(body: Body, ou: float, ov: float, u: float, v: float, angle: float, r: float) -> bool:
    """Whether a disc of radius r overlaps an occupied square while its centre turns about (ou, ov), by
    `angle` [rad] from (u, v), where it overlaps none.
    """
    h, reach, start = body.resolution, math.hypot(u - ou, v - ov), math.atan2(v - ov, u - ou)
    mu, mv = ou + reach * math.cos(start + 0.5 * angle), ov + reach * math.sin(start + 0.5 * angle)
    around = r + reach * min(0.5 * abs(angle), 2.0)  # of the middle of the arc, all that the disc can touch
    if room_around(body, mu, mv) >= around:
        return False
    left, right = _span(body, mu - around, mu + around, body.occupied.shape[1])
    for j in range(*_span(body, mv - around, mv + around, body.occupied.shape[0])):
        for i in range(left, right):
            if not _is_occupied(body, j, i):
                continue
            near = _to_square(mu, mv, i * h, j * h, h)
            if near < r or (near < around and _arc_nears(ou, ov, reach, start, angle, i * h, j * h, h, r)):
                return True
    return False


@leaf
def _arc_nears(
    ou: float, ov: float, reach: float, start: float, angle: float, u0: float, v0: float, h: float, r: float
) -> bool:
    """Whether an arc comes nearer than r to the square of side h whose lower-left corner is (u0, v0).

    The distance to a square is smooth outside of it. So along the arc it is least at an end, or where the
    arc is square to the way there: towards a corner, or along an axis. Or the arc crosses an edge.
    """
    end = start + angle
    if _to_square(ou + reach * math.cos(end), ov + reach * math.sin(end), u0, v0, h) < r:
        return True
    for k in range(4):
        cu, cv = u0 + h * (k % 2) - ou, v0 + h * (k // 2) - ov
        # The lines along the edges: u = u0, u = u0 + h, v = v0, v = v0 + h.
        line, along = (cu, 0.0) if k < 2 else (v0 + h * (k - 2) - ov, 0.5 * math.pi)
        off = math.acos(line / reach) if abs(line) < reach else math.nan  # NaN: it is crossed nowhere
        for at in (math.atan2(cv, cu), 0.5 * math.pi * k, along - off, along + off):
            turned = (at - start) % (2.0 * math.pi)
            passed = turned if angle > 0.0 else (2.0 * math.pi - turned) % (2.0 * math.pi)
            u, v = ou + reach * math.cos(at), ov + reach * math.sin(at)
            if passed <= abs(angle) and _to_square(u, v, u0, v0, h) < r:  # the arc has that point
                return True
    return False


@inlined
def _to_square(u: float, v: float, u0: float, v0: float, h: float) -> float:
    return math.hypot(max(u0 - u, 0.0, u - (u0 + h)), max(v0 - v, 0.0, v - (v0 + h)))


@leaf
def can_turn(body: Body, x: float, y: float, theta: float, angle: float) -> bool:
    """Whether the robot can turn on the spot by an angle [rad]."""
    if body.offset_x == 0.0 and body.offset_y == 0.0:
        return True
    u, v = centre(body, x, y, theta)
    if room_around(body, u, v) >= body.radius + 2.0 * math.hypot(body.offset_x, body.offset_y):
        return True
    gap = free_distance(body, u, v, body.radius)
    if gap > 0.0:
        r = max(min(body.radius - ROUNDING, gap - 1e-12), 0.0)
        return not _arc_contact(body, *in_grid(body, x, y), u, v, angle, r)
    inside, n = _depth(body, u, v), math.ceil(abs(angle) / CHORD - 1e-9)
    for k in range(1, n + 1):
        if _depth(body, *centre(body, x, y, theta + angle * k / n)) > inside + ROUNDING:
            return False
    return True


@leaf
def overlap(body: Body, x: float, y: float, theta: float) -> float:
    """How deep [m] the footprint overlaps an obstacle: 0 where free, radius where its centre is inside."""
    u, v = centre(body, x, y, theta)
    return body.radius - free_distance(body, u, v, body.radius)


@leaf
def in_collision(body: Body, x: float, y: float, theta: float) -> bool:
    return overlap(body, x, y, theta) > TOUCH
