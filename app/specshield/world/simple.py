"""Whether a polygon is simple: no two edges touch, except neighbours at the vertex that they share."""

from __future__ import annotations

from specshield.arrays import Floats
from specshield.compiled import kernel


@kernel
def _side(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> int:
    """1, 0 or -1: c is left of, on or right of the line from a to b."""
    cross = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    return (cross > 0.0) - (cross < 0.0)


@kernel
def crossing_edges(v: Floats) -> tuple[int, int]:
    """The first two edges of a closed polygon v[n, 2] that share a point they should not, or (-1, -1)."""
    n = v.shape[0]
    for i in range(n):
        a, b = v[i], v[(i + 1) % n]
        if a[0] == b[0] and a[1] == b[1]:
            return i, (i + 1) % n
        for j in range(i + 1, n):
            c, d = v[j], v[(j + 1) % n]
            abc, abd = _side(a[0], a[1], b[0], b[1], c[0], c[1]), _side(a[0], a[1], b[0], b[1], d[0], d[1])
            cda, cdb = _side(c[0], c[1], d[0], d[1], a[0], a[1]), _side(c[0], c[1], d[0], d[1], b[0], b[1])
            if j == i + 1 or j - i == n - 1:  # neighbours share a vertex: wrong only if one folds back
                back = (b[0] - a[0]) * (d[0] - c[0]) + (b[1] - a[1]) * (d[1] - c[1]) < 0.0
                if abc == 0 and abd == 0 and back:
                    return i, j
                continue
            apart = (
                max(a[0], b[0]) < min(c[0], d[0])
                or max(c[0], d[0]) < min(a[0], b[0])
                or max(a[1], b[1]) < min(c[1], d[1])
                or max(c[1], d[1]) < min(a[1], b[1])
            )
            if not apart and abc * abd <= 0 and cda * cdb <= 0:
                return i, j
    return -1, -1
