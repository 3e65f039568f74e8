"""The occupancy grid: which cells of the floor are occupied, and how far each cell is from those."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from specshield.arrays import Bools, Floats
from specshield.compiled import kernel
from specshield.errors import MapError
from specshield.world import checks

MAX_SIDE = 4000  # [cells] 200 m at 0.05 m; the clearance of such a map takes 128 MB


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Square cells in the map frame. Outside the grid everything is occupied.

    occupied: bool[height, width], row 0 is the lowest y; read-only.
    resolution: side of a cell in metres.
    origin: (x, y, yaw) of the lower-left corner of the lower-left cell, in metres and radians.

    Grids are equal when their content_hash is. Raises MapError for sizes or numbers out of range.
    """

    occupied: Bools
    resolution: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        occupied = np.array(self.occupied, dtype=np.bool_, order="C")
        if occupied.ndim != 2:
            raise MapError(
                "cells have to be an array [height, width]",
                path="cells",
                got=list(occupied.shape),
                expected="two axes",
            )
        check_size(occupied.shape[1], occupied.shape[0])
        occupied.flags.writeable = False
        object.__setattr__(self, "occupied", occupied)
        object.__setattr__(self, "resolution", checks.number(self.resolution, "resolution", 1e-4, 100.0))
        x, y, yaw = checks.numbers(self.origin, 3, "origin")
        object.__setattr__(self, "origin", (x, y, yaw))

    @property
    def height(self) -> int:
        return int(self.occupied.shape[0])

    @property
    def width(self) -> int:
        return int(self.occupied.shape[1])

    @cached_property
    def content_hash(self) -> str:
        """sha256 in hex over size, resolution, origin and cells."""
        numbers = np.array([self.height, self.width, self.resolution, *self.origin], dtype="<f8")
        numbers += 0.0  # no -0.0
        return hashlib.sha256(numbers.tobytes() + np.packbits(self.occupied).tobytes()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, OccupancyGrid) and self.content_hash == other.content_hash

    def __hash__(self) -> int:
        return hash(self.content_hash)

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """(xmin, ymin, xmax, ymax) of the grid in the map frame, in metres."""
        w, h = self.width * self.resolution, self.height * self.resolution
        corners = self.to_map([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]])
        (xmin, ymin), (xmax, ymax) = corners.min(axis=0), corners.max(axis=0)
        return float(xmin), float(ymin), float(xmax), float(ymax)

    @cached_property
    def clearance(self) -> Floats:
        """Metres from each cell's centre to the nearest obstacle. Shape [height, width], read-only.

        Exact Euclidean distance to the nearest point of any occupied cell's closed square or of the
        outside of the grid; 0 in occupied cells, at least resolution / 2 in free ones. A point p in the
        cell with centre c is between clearance - |p - c| and clearance + |p - c| from the nearest obstacle.
        """
        clearance: Floats = np.sqrt(_squared_half_cells(self.occupied)) * (self.resolution / 2)
        clearance.flags.writeable = False
        return clearance

    def to_grid(self, points: ArrayLike) -> Floats:
        """Map frame to grid frame, [..., 2] to [..., 2], metres.

        The grid's lower-left corner is (0, 0), its first axis runs along the columns and its second along the
        rows: a point's cell is floor(point / resolution).
        """
        x0, y0, yaw = self.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        delta = np.asarray(points, dtype=np.float64) - (x0, y0)
        dx, dy = delta[..., 0], delta[..., 1]
        return np.stack([dx * cos + dy * sin, dy * cos - dx * sin], axis=-1)

    def holds(self, points: ArrayLike) -> Bools:
        """Which points [..., 2] of the map frame lie on the map. Shape [...]."""
        at = self.to_grid(points)
        inside = (at >= 0.0) & (at < (self.width * self.resolution, self.height * self.resolution))
        return np.asarray(inside.all(axis=-1))

    def to_map(self, points: ArrayLike) -> Floats:
        """Grid frame to map frame: the inverse of to_grid."""
        x0, y0, yaw = self.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        grid = np.asarray(points, dtype=np.float64)
        gx, gy = grid[..., 0], grid[..., 1]
        return np.stack([x0 + gx * cos - gy * sin, y0 + gx * sin + gy * cos], axis=-1)

    @cached_property
    def centres(self) -> Floats:
        """Cell centres in the map frame, metres. Shape [height, width, 2]."""
        columns, rows = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return self.to_map(np.stack([columns, rows], axis=-1) * self.resolution)


def check_size(width: int, height: int) -> None:
    """Raises MapError unless both are from 1 to MAX_SIDE cells."""
    for path, side in (("width", width), ("height", height)):
        if not 1 <= side <= MAX_SIDE:
            raise MapError(
                f"a map cannot have {width} x {height} cells",
                path=path,
                got=side,
                expected=f"1 to {MAX_SIDE} cells",
            )


@kernel
def _squared_half_cells(occupied: Bools) -> Floats:
    """Squared distance from each cell's centre to the nearest occupied square, in half cells.

    It is a whole number, so exact: on the lattice of half cells a centre is (2i + 1, 2j + 1), and the nearest
    point of a square is one of its nine lattice points. Distances along the rows come first, then down the
    columns the lower envelope of parabolas (Felzenszwalb and Huttenlocher, Distance Transforms of Sampled
    Functions, 2012). A ring of occupied cells around the grid stands for the outside.
    """
    h, w = occupied.shape
    along = np.zeros((h + 2, w))  # half cells to the nearest occupied square of the same row, ring included
    for i in range(h):
        last = -1
        for j in range(w):
            if occupied[i, j]:
                last = j
            along[i + 1, j] = max(2 * (j - last) - 1, 0)
        last = w
        for j in range(w - 1, -1, -1):
            if occupied[i, j]:
                last = j
            along[i + 1, j] = min(along[i + 1, j], max(2 * (last - j) - 1, 0))

    n = 2 * (h + 2) + 1
    height, vertex, edge = np.empty(n), np.empty(n, np.int64), np.empty(n + 1)
    out = np.empty((h, w))
    for j in range(w):
        for i in range(h + 2):
            height[2 * i + 1] = along[i, j] ** 2
        height[0] = height[n - 1] = 0.0
        for i in range(1, h + 2):
            height[2 * i] = min(height[2 * i - 1], height[2 * i + 1])
        k = 0
        vertex[0], edge[0], edge[1] = 0, -np.inf, np.inf
        for q in range(1, n):
            while True:
                v = vertex[k]
                cross = ((height[q] + q * q) - (height[v] + v * v)) / (2.0 * (q - v))
                if cross > edge[k]:
                    break
                k -= 1
            k += 1
            vertex[k], edge[k], edge[k + 1] = q, cross, np.inf
        k = 0
        for i in range(h):
            y = 2 * i + 3  # the centre of row i, one cell of ring below it
            while edge[k + 1] < y:
                k += 1
            out[i, j] = (y - vertex[k]) ** 2 + height[vertex[k]]
    return out
