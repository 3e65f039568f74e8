"""What a session has learned of its map: the cells that are not as the map of its policy has them.

Points that the robot's sensors saw occupied or free change cells, and so do contacts. The map of the policy
stays what it is; `applied` gives the session's own. What is learned is a value: it goes from one decision to
the next as bytes, so that a replay, or another process, learns the same.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import blake2b

import numpy as np
from numpy.typing import ArrayLike

from specshield.arrays import Bools, Floats, Ints
from specshield.compiled import kernel
from specshield.errors import SampleError
from specshield.world.occupancy import OccupancyGrid

MAX_POINTS = 2000  # of each kind, in one step
MAX_CELLS = 100_000  # that differ from the policy's map: 10 x 25 m of 5 cm cells, half a megabyte as bytes
# What changed a cell: a point that was sent, or a motion that stopped short. A motion marks cells straight
# ahead, to the left, to the right, and behind these, as far as the obstacle may reach.
SENT, CONTACT, LEFT, RIGHT, BEHIND = range(5)
FEW_ROWS = 64  # of new cells: with more of them, a clearance made anew takes as long (measured, 10 x 10 m)


@dataclass(frozen=True, eq=False)
class LearnedMap:
    """Changed cells, N of them.

    cell [N]: row * width + column, ascending. occupied [N]: on the session's map; the policy's map has the
    opposite. by [N]: SENT, CONTACT, LEFT, RIGHT or BEHIND. step [N]: at which each was seen last. revision:
    how often cells have changed, which may be more than once in a step.
    """

    revision: int = 0
    cell: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    occupied: Bools = field(default_factory=lambda: np.empty(0, np.bool_))
    by: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    step: Ints = field(default_factory=lambda: np.empty(0, np.int64))

    @cached_property
    def digest(self) -> bytes:
        """A hash of the cells and whether they are occupied, whatever changed them and when."""
        cells = self.cell.astype("<i8").tobytes() + np.packbits(self.occupied).tobytes()
        return blake2b(cells, digest_size=16).digest()

    def to_bytes(self) -> bytes:
        if not self.revision:
            return b""
        columns = (np.diff(self.cell, prepend=0), self.occupied, self.by, self.step)
        table = np.stack([column.astype("<i4") for column in columns]).tobytes()
        return zlib.compress(self.revision.to_bytes(8, "little") + table, 1)

    @staticmethod
    def from_bytes(value: bytes) -> LearnedMap:
        """The inverse of `to_bytes`."""
        if not value:
            return NONE
        content = zlib.decompress(value)
        table = np.frombuffer(content, "<i4", offset=8).reshape(4, -1).astype(np.int64)
        cell, occupied, by, step = np.cumsum(table[0]), table[1] != 0, table[2], table[3]
        return LearnedMap(int.from_bytes(content[:8], "little"), cell, occupied, by, step)

    def __len__(self) -> int:
        return len(self.cell)


NONE = LearnedMap()


def cells_of(grid: OccupancyGrid, points: Floats) -> tuple[Ints, int]:
    """The cells that points [n, 2] of the map frame [m] lie in, ascending, and how many lie outside."""
    column, row = np.floor(grid.to_grid(points) / grid.resolution).T
    inside = (column >= 0) & (row >= 0) & (column < grid.width) & (row < grid.height)
    flat = row[inside].astype(np.int64) * grid.width + column[inside].astype(np.int64)
    return np.unique(flat), int(len(points) - inside.sum())


def check_points(points: ArrayLike, path: str) -> Floats:
    """Points as an array [n, 2]. Raises SampleError unless they are finite, and at most MAX_POINTS."""
    try:
        array = np.asarray(points, dtype=np.float64)
        array = array.reshape(-1, 2) if array.size == 0 else array
        if array.ndim == 2 and array.shape[1] == 2 and len(array) <= MAX_POINTS and np.isfinite(array).all():
            return array
        got: object = list(array.shape)
    except (TypeError, ValueError):
        got = str(points)[:80]
    expected = f"at most {MAX_POINTS} finite [x, y] in metres"
    raise SampleError("not a list of points", path=path, got=got, expected=expected)


def learn(
    grid: OccupancyGrid, known: LearnedMap, t: int, cells: Ints, occupied: bool, by: int = SENT
) -> LearnedMap:
    """What is known once `cells` [n], ascending, were found occupied or free at step t. Same revision.

    Cells that agree with the policy's map are not kept, and no more than MAX_CELLS are.
    """
    if not len(cells):
        return known
    others = _rows(known, ~np.isin(known.cell, cells, assume_unique=True))
    differs = cells[grid.occupied.ravel()[cells] != occupied][: max(MAX_CELLS - len(others), 0)]
    count = len(differs)
    both = LearnedMap(
        known.revision,
        np.concatenate([others.cell, differs]),
        np.concatenate([others.occupied, np.full(count, occupied)]),
        np.concatenate([others.by, np.full(count, by)]),
        np.concatenate([others.step, np.full(count, t)]),
    )
    return _rows(both, np.argsort(both.cell, kind="stable"))


def forget(known: LearnedMap, old: Bools) -> LearnedMap:
    """`known` without the cells marked in `old` [N]. Same revision."""
    return _rows(known, ~old) if old.any() else known


def _rows(known: LearnedMap, which: Bools | Ints) -> LearnedMap:
    """The cells that an index array or a mask picks. Same revision."""
    cell, occupied, by, step = known.cell, known.occupied, known.by, known.step
    return LearnedMap(known.revision, cell[which], occupied[which], by[which], step[which])


def revised(before: LearnedMap, after: LearnedMap) -> LearnedMap:
    """`after`, with the next revision if some cell is not what it was `before`."""
    return replace(after, revision=before.revision + (before.digest != after.digest))


def applied(grid: OccupancyGrid, known: LearnedMap) -> OccupancyGrid:
    """The session's own map. Where cells only became occupied, its clearance changes near these alone."""
    if not len(known):
        return grid
    occupied = grid.occupied.copy()
    occupied.ravel()[known.cell] = known.occupied
    made = replace(grid, occupied=occupied)
    rows = np.unique(known.cell // grid.width)
    if known.occupied.all() and len(rows) <= FEW_ROWS:
        clearance = grid.clearance.copy()
        _come_nearer(clearance, known.cell, rows, float(clearance.max()), grid.resolution)
        clearance.flags.writeable = False
        made.__dict__["clearance"] = clearance
    return made


@kernel
def _come_nearer(clearance: Floats, cells: Ints, rows: Ints, farthest: float, resolution: float) -> None:
    """Takes cells [n] that became occupied, in these rows, into the clearance [height, width], whose greatest
    value is `farthest` [m]. It counts half cells as `OccupancyGrid.clearance` does, to the same last bit.
    """
    height, width = clearance.shape
    reach = int(farthest / resolution) + 2
    top, bottom = max(rows[0] - reach, 0), min(rows[-1] + reach + 1, height)
    left, right = max((cells % width).min() - reach, 0), min((cells % width).max() + reach + 1, width)
    near, along = np.full((bottom - top, right - left), math.inf), np.empty(right - left)
    for row in rows:
        along[:] = math.inf
        for cell in cells[cells // width == row]:
            along[cell % width - left] = 0.0
        for j in range(1, right - left):  # to the nearest square's edge: half a cell, then whole ones
            along[j] = min(along[j], along[j - 1] + (1.0 if along[j - 1] == 0.0 else 2.0))
        for j in range(right - left - 2, -1, -1):
            along[j] = min(along[j], along[j + 1] + (1.0 if along[j + 1] == 0.0 else 2.0))
        for i in range(top, bottom):
            away = float(max(2 * abs(i - row) - 1, 0))
            for j in range(right - left):
                near[i - top, j] = min(near[i - top, j], away * away + along[j] * along[j])
    for i in range(top, bottom):
        for j in range(left, right):
            far = math.sqrt(near[i - top, j - left]) * (resolution / 2)
            clearance[i, j] = min(clearance[i, j], far)
