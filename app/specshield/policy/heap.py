"""A binary heap of rows, the least rank first, in two arrays that compiled code fills."""

from __future__ import annotations

from typing import NamedTuple

from specshield.arrays import Floats, Int32s
from specshield.compiled import inlined


class Heap(NamedTuple):
    """row [N]: the rows in it, row[0] that of the least rank; rank [N]. What follows its size is scratch."""

    row: Int32s
    rank: Floats


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
