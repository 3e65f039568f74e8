"""Distance along free space: the solution of |grad d| = 1 by fast marching (Sethian, 1996)."""

from __future__ import annotations

import heapq
import math

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.compiled import kernel

# [cells] around the goal within which straight lines give the distance, since upwinding errs most near a
# point source. Chosen by hand; nothing was measured.
EXACT_WITHIN = 12


def geodesic_distance(free: Bools, goal: Bools, resolution: float) -> Floats:
    """Metres from each cell centre to the nearest goal cell's centre through free cells. [height, width].

    free, goal: bool[height, width]; goal cells that are not free do not count. The distance is 0 in the goal
    and inf where the goal cannot be reached. Free cells that touch only at a corner are not connected. The
    scheme is first-order upwind: it is never short by more than rounding, and about 2 % too long, near
    corners by half a cell more.
    """
    goal = np.ascontiguousarray(goal & free)
    blocked = np.zeros((free.shape[0] + 1, free.shape[1] + 1), dtype=np.int64)
    blocked[1:, 1:] = np.cumsum(np.cumsum(~free, axis=0), axis=1)
    result: Floats = _march(np.ascontiguousarray(free), goal, blocked) * resolution
    return result


@kernel
def _march(free: Bools, goal: Bools, blocked: Ints) -> Floats:
    h, w = free.shape
    distance = np.full((h, w), np.inf)
    done = np.zeros((h, w), dtype=np.bool_)
    for i in range(h):
        for j in range(w):
            if goal[i, j]:
                distance[i, j] = 0.0
                inner = 0 < i < h - 1 and 0 < j < w - 1
                if inner and goal[i - 1, j] and goal[i + 1, j] and goal[i, j - 1] and goal[i, j + 1]:
                    continue  # one of its neighbours is nearer to every other cell
                _straight_lines(i, j, blocked, distance)
    heap = [(0.0, -1)]
    for i in range(h):
        for j in range(w):
            if distance[i, j] < np.inf:
                heapq.heappush(heap, (distance[i, j], i * w + j))
    while len(heap) > 0:
        _, cell = heapq.heappop(heap)
        i, j = cell // w, cell % w
        if cell < 0 or done[i, j]:
            continue
        done[i, j] = True
        for di, dj in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            y, x = i + di, j + dj
            if 0 <= y < h and 0 <= x < w and free[y, x] and not done[y, x]:
                update = _upwind(distance, done, y, x)
                if update < distance[y, x]:
                    distance[y, x] = update
                    heapq.heappush(heap, (update, y * w + x))
    return distance


@kernel
def _straight_lines(i: int, j: int, blocked: Ints, distance: Floats) -> None:
    """Exact distances from goal cell (i, j) to nearby cells, where the whole rectangle between is free."""
    h, w = distance.shape
    for y in range(max(0, i - EXACT_WITHIN), min(h, i + EXACT_WITHIN + 1)):
        for x in range(max(0, j - EXACT_WITHIN), min(w, j + EXACT_WITHIN + 1)):
            d = math.sqrt(float((y - i) ** 2 + (x - j) ** 2))
            if d > EXACT_WITHIN or d >= distance[y, x]:
                continue
            top, bottom, right, left = max(i, y) + 1, min(i, y), max(j, x) + 1, min(j, x)
            if blocked[top, right] - blocked[bottom, right] - blocked[top, left] + blocked[bottom, left] == 0:
                distance[y, x] = d


@kernel
def _upwind(distance: Floats, done: Bools, i: int, j: int) -> float:
    """d with (d - a)^2 + (d - b)^2 = 1 over the smaller settled neighbour of each axis, or min + 1."""
    h, w = distance.shape
    a = b = np.inf
    if i > 0 and done[i - 1, j]:
        a = distance[i - 1, j]
    if i < h - 1 and done[i + 1, j]:
        a = min(a, distance[i + 1, j])
    if j > 0 and done[i, j - 1]:
        b = distance[i, j - 1]
    if j < w - 1 and done[i, j + 1]:
        b = min(b, distance[i, j + 1])
    if abs(a - b) >= 1.0:  # one of them is finite, since some neighbour is settled
        return min(a, b) + 1.0
    return (a + b + math.sqrt(2.0 - (a - b) ** 2)) / 2.0


def falling(onward: Floats, off: Floats, resolution: float) -> Floats:
    """A field [height, width] that falls along the way to a goal: the distance `onward` to it through roomy
    space; beside obstacles, where that is inf, above all of these by the distance `off` to that space.
    """
    reached = np.isfinite(onward)
    return np.where(reached, onward, onward[reached].max(initial=0.0) + resolution + off)


@kernel
def downhill(height: Floats, steps: int) -> Ints:
    """The cell, row * width + column, that lies so many steps down the steepest way from each cell. Shape
    [height * width].
    """
    rows, columns = height.shape
    after = np.empty(rows * columns, np.int64)
    for j in range(rows):
        for i in range(columns):
            best, at = 0.0, j * columns + i
            for dj in range(-1, 2):
                for di in range(-1, 2):
                    row, column = j + dj, i + di
                    inside = 0 <= row < rows and 0 <= column < columns
                    if (dj != 0 or di != 0) and inside and height[row, column] < np.inf:
                        fall = (height[j, i] - height[row, column]) / math.hypot(dj, di)
                        if fall > best:
                            best, at = fall, row * columns + column
            after[j * columns + i] = at
    found = np.arange(rows * columns)
    for _ in range(steps):
        found = after[found]
    return found
