"""What the cells of printed tables say, and cells of the page's own tables."""

from __future__ import annotations

import re
from collections.abc import Iterable

from evaluation.results import share
from evaluation.statistics import clopper_pearson
from evaluation.uncertainty.figures import Table

Count = tuple[int, int]  # k of n


def count(cell: str) -> Count:
    """`58 of 60 (88.5 to 99.6 %)` as (58, 60)."""
    found = re.match(r"(\d+) of (\d+)", cell)
    if found is None:
        raise ValueError(f"no count begins this cell: {cell}")
    return int(found[1]), int(found[2])


def number(cell: str) -> float:
    """The number that begins a cell, as the mean before its interval."""
    return float(cell.split()[0])


def total(counts: Iterable[Count]) -> Count:
    k, n = map(sum, zip(*counts, strict=True))
    return k, n


def interval(k: int, n: int) -> str:
    """`58 of 60 (88.5 to 99.6 %)`; `of 0` where there was nothing to keep."""
    if not n:
        return "0 of 0"
    low, high = clopper_pearson(k, n)
    return share({"count": k, "of": n, "low": low, "high": high})


def below(k: int, n: int, least: int) -> bool:
    """Whether fewer than `least` per cent were kept."""
    return 100 * k < least * n


def where(table: Table, **wanted: str) -> Table:
    """The rows with these cells."""
    return [row for row in table if all(row[head] == cell for head, cell in wanted.items())]


def intervals(counts: Iterable[Count]) -> str:
    """A line with the interval of each count that occurs, for tables too wide to hold them."""
    found = sorted(set(counts), key=lambda each: (each[1], each[0]), reverse=True)
    return f"The 95 % intervals: {'; '.join(interval(*each) for each in found)}."
