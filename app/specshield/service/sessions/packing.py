"""Stores the numbers of a record in few bytes: a table of the actions, and lists without a frequent value."""

from __future__ import annotations

import math

import numpy as np

from specshield.arrays import Bytes, Codes, Floats
from specshield.compiled import kernel

COLUMNS = 5  # of an action's row in the table: J, rho, x, y, theta


def _known(row: Floats) -> Floats:
    """The numbers [6] that a record does not store: those of x_t, which next poses often share, 0, 1, NaN."""
    return np.array([*row[:3].tolist(), 0.0, 1.0, math.nan], "<f8")


def pack_table(actions: Floats, row: Floats) -> tuple[bytes, bytes, bytes]:
    """The members `rows`, `table` and `pool` of a record. actions [A, 5]: J, rho, x, y, theta; NaN for null.
    row: the session's row of this step.
    """
    known, size = _known(row), actions.size
    rows, table, pool = np.empty(len(actions), np.uint8), np.empty(size, np.uint16), np.empty(size)
    distinct, fresh = _take_apart(actions, known, rows, table, pool)
    wide = np.uint8 if len(known) + fresh <= 256 else np.uint16
    return rows.tobytes(), table[: distinct * COLUMNS].astype(wide).tobytes(), pool[:fresh].tobytes()


@kernel
def _take_apart(actions: Floats, known: Floats, rows: Bytes, table: Codes, pool: Floats) -> tuple[int, int]:
    """Writes rows [A], table and pool as `StepRecord` has them. Returns the number of distinct rows, and of
    numbers in the pool. Numbers are equal if all their bits are.
    """
    words, seen, fresh = actions.view(np.int64), known.view(np.int64), pool.view(np.int64)
    firsts, distinct, count = np.empty(len(words), np.int64), 0, 0
    for a in range(len(words)):
        at, same = 0, 0
        while at < distinct and same < COLUMNS:
            first, same = firsts[at], 0
            while same < COLUMNS and words[first, same] == words[a, same]:
                same += 1
            at += same < COLUMNS
        rows[a] = at
        if at < distinct:
            continue
        firsts[distinct] = a
        distinct += 1
        for column in range(COLUMNS):
            word, place = words[a, column], 0
            while place < len(seen) and seen[place] != word:
                place += 1
            while len(seen) <= place < len(seen) + count and fresh[place - len(seen)] != word:
                place += 1
            if place == len(seen) + count:
                fresh[count] = word
                count += 1
            table[at * COLUMNS + column] = place
    return distinct, count


def unpack_table(rows: bytes, table: bytes, pool: bytes, row: Floats) -> Floats:
    """The `actions` [A, 5] that `pack_table` was given."""
    words = np.concatenate([_known(row), np.frombuffer(pool, "<f8")])
    wide = "<u1" if len(words) <= 256 else "<u2"
    distinct = words[np.frombuffer(table, wide)].reshape(-1, COLUMNS)
    actions: Floats = distinct[np.frombuffer(rows, "<u1")]
    return actions


def sparse(values: Floats, absent: float, shortens: bool) -> bytes:
    """The values without those that equal `absent`: one bit for each value says whether it follows, as
    float64 or, with `shortens` and where that loses nothing, as float32.
    """
    bits, kept = np.zeros((len(values) + 7) // 8, np.uint8), np.empty(len(values))
    count, short = _keep(values, absent, bits, kept)
    return bits.tobytes() + kept[:count].astype("<f4" if short and shortens else "<f8").tobytes()


@kernel
def _keep(values: Floats, absent: float, bits: Bytes, kept: Floats) -> tuple[int, bool]:
    """Sets the bits of the values that are not `absent`, and writes these values into `kept`. Returns their
    number, and whether float32 can hold them all.
    """
    count, short = 0, True
    for i in range(len(values)):
        if values[i] != absent or np.signbit(values[i]) != np.signbit(absent):
            bits[i >> 3] |= 128 >> (i & 7)
            kept[count] = values[i]
            count += 1
            short = short and float(np.float32(values[i])) == values[i]
    return count, short


def full(content: bytes, size: int, absent: float, shortens: bool) -> Floats:
    """The `values` that `sparse` was given."""
    head = (size + 7) // 8
    there = np.unpackbits(np.frombuffer(content, np.uint8, head), count=size).view(np.bool_)
    values = np.full(size, absent)
    short = shortens and len(content) - head == 4 * int(there.sum())
    values[there] = np.frombuffer(content, "<f4" if short else "<f8", offset=head)
    return values
