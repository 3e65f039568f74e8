"""The poses that a search over exact motions has come to, how it came to each, and those to go on from."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Int8s, Int32s, Ints
from specshield.compiled import inlined, kernel, leaf

DEGREE = 180.0 / math.pi  # `Grain.turn` for headings that are the same to a degree


class Heap(NamedTuple):
    """A binary heap in arrays, the least rank first. row [N]: the rows in it; rank [N]: of each. What follows
    its size is scratch.
    """

    row: Int32s
    rank: Floats


class Tree(NamedTuple):
    """N poses [N, 3], the root first, each with its progress, status and run [N, K]; the motions made up to
    it, its parent and the motion that led to it, [N].

    heap: the rows to go on from. table: a hash table of rows, at most half full, -1 where it is empty.
    """

    pose: Floats
    status: Int8s
    run: Ints
    made: Int32s
    parent: Int32s
    motion: Int32s
    heap: Heap
    table: Int32s


class Grain(NamedTuple):
    """Poses are nearly the same whose x, times `scale` [1/m] over `size`, round down to the same number, as
    their y do, and whose headings, times `turn` [1/rad], round to the same.
    """

    scale: float
    size: float
    turn: float


@inlined
def table_size(rows: int) -> int:
    """The size of a table that so many rows leave half empty at least: a power of two."""
    size = 4
    while size < 2 * rows:
        size *= 2
    return size


@kernel
def make_tree(most: int, obligations: int) -> Tree:
    """Room for `most` poses with the progress of so many obligations."""
    return Tree(
        pose=np.empty((most, 3)),
        status=np.empty((most, obligations), np.int8),
        run=np.empty((most, obligations), np.int64),
        made=np.empty(most, np.int32),
        parent=np.empty(most, np.int32),
        motion=np.empty(most, np.int32),
        heap=Heap(np.empty(most, np.int32), np.empty(most)),
        table=np.full(table_size(most), -1, np.int32),
    )


@inlined
def put(tree: Tree, row: int, x: float, y: float, theta: float, made: int, parent: int, motion: int) -> None:
    """Writes a row's pose, and how it was reached; the progress of the row is left as it is."""
    tree.pose[row, 0], tree.pose[row, 1], tree.pose[row, 2] = x, y, theta
    tree.made[row], tree.parent[row], tree.motion[row] = made, parent, motion


@leaf
def enter(tree: Tree, row: int, grain: Grain, sooner: bool) -> int:
    """Puts a row into the table and returns its slot; -1 if an earlier row has nearly the same pose and the
    same progress and, if `sooner`, was reached in as few motions. Only rows of one grain are compared.

    Until the next row is put, it is the last of its chain: -1 in its slot takes it out again.
    """
    x, y, h = _rounded(tree.pose, row, grain)
    key = x * 73856093 ^ y * 19349663 ^ h * 83492791
    for k in range(tree.status.shape[1]):
        key = key * 31 + tree.status[row, k]
    slot = (key ^ key >> 15) & (tree.table.shape[0] - 1)
    while tree.table[slot] >= 0:
        other = tree.table[slot]
        same = _rounded(tree.pose, other, grain) == (x, y, h)
        for k in range(tree.status.shape[1]):
            same = same and tree.status[row, k] == tree.status[other, k]
        if same and not (sooner and tree.made[row] < tree.made[other]):
            return -1
        slot = (slot + 1) & (tree.table.shape[0] - 1)
    tree.table[slot] = row
    return int(slot)


@inlined
def _rounded(pose: Floats, row: int, grain: Grain) -> tuple[int, int, int]:
    x, y = pose[row, 0] * grain.scale / grain.size, pose[row, 1] * grain.scale / grain.size
    return math.floor(x), math.floor(y), math.floor(pose[row, 2] * grain.turn + 0.5)


@leaf
def trace(tree: Tree, row: int, motions: Ints) -> None:
    """Writes the motions from the root to a row into the first of `motions`."""
    while tree.parent[row] >= 0:
        motions[tree.made[row] - 1] = tree.motion[row]
        row = tree.parent[row]


@inlined
def push(heap: Heap, size: int, row: int, rank: float) -> int:
    """Puts a row into a heap of `size`; its new size."""
    at = size
    while at > 0 and heap.rank[(at - 1) // 2] > rank:
        heap.row[at], heap.rank[at] = heap.row[(at - 1) // 2], heap.rank[(at - 1) // 2]
        at = (at - 1) // 2
    heap.row[at], heap.rank[at] = row, rank
    return size + 1


@inlined
def pop(heap: Heap, size: int) -> int:
    """Takes row[0] out of a heap of `size`; its new size."""
    size -= 1
    row, rank, at = heap.row[size], heap.rank[size], 0
    while 2 * at + 1 < size:
        child = 2 * at + 1
        if child + 1 < size and heap.rank[child + 1] < heap.rank[child]:
            child += 1
        if heap.rank[child] >= rank:
            break
        heap.row[at], heap.rank[at] = heap.row[child], heap.rank[child]
        at = child
    heap.row[at], heap.rank[at] = row, rank
    return size


@inlined
def sink(heap: Heap, hole: int, size: int, row: int, rank: float) -> None:
    """Puts a row into heap[:size] at `hole` or below, the lowest row first on ties. The hole first moves down
    to the end, then the row moves up from there. It mostly belongs near the end, so few branches are
    mispredicted.
    """
    at = hole
    while 2 * at + 1 < size:
        child = 2 * at + 1
        if child + 1 < size:
            child += _is_before(heap, child + 1, heap.row[child], heap.rank[child])
        heap.row[at], heap.rank[at] = heap.row[child], heap.rank[child]
        at = child
    while at > hole and not _is_before(heap, (at - 1) // 2, row, rank):
        heap.row[at], heap.rank[at] = heap.row[(at - 1) // 2], heap.rank[(at - 1) // 2]
        at = (at - 1) // 2
    heap.row[at], heap.rank[at] = row, rank


@inlined
def _is_before(heap: Heap, at: int, row: int, rank: float) -> bool:
    """Whether what is at a place of the heap comes before a row of this rank."""
    other = heap.rank[at]
    return bool((other < rank) | ((other == rank) & (heap.row[at] < row)))
