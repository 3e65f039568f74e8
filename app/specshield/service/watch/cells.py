"""Counts and histograms that take little time of a step, and that survive the kill of a process.

Each process has a file of float64 cells, mapped into memory, to which the thread of its event loop adds. The
process that answers /metrics sums the files of all processes. The counts of a step take 3 us (`python -m
benchmarks.watch`). With prometheus_client, whose files also hold names and times, they would take 24 us.
"""

from __future__ import annotations

import mmap
import os
from bisect import bisect_left
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from prometheus_client.metrics_core import CounterMetricFamily, HistogramMetricFamily, Metric

from specshield.arrays import Floats
from specshield.service.storage.keeper import private

SIZE = 512  # cells; a page of memory


class Family(NamedTuple):
    """A counter, or with `bounds` a histogram; with `label` one for each of its `values`.

    first: its first cell. A counter has one cell. A histogram has one for each bucket, of which the last has
    no upper bound, and one for the sum.
    """

    name: str
    help: str
    first: int
    label: str | None
    values: tuple[str, ...]
    bounds: tuple[float, ...]

    @property
    def width(self) -> int:
        return len(self.bounds) + 2 if self.bounds else 1

    def cell(self, value: str = "") -> int:
        return self.first + self.width * (self.values.index(value) if self.label else 0)

    def metric(self, cells: Floats) -> Metric:
        labels = [self.label] if self.label else []
        kind = HistogramMetricFamily if self.bounds else CounterMetricFamily
        family: Metric = kind(self.name, self.help, labels=labels)
        for value in self.values:
            held = cells[self.cell(value) : self.cell(value) + self.width]
            given = [value] if self.label else []
            if isinstance(family, HistogramMetricFamily):
                names = [*map(str, self.bounds), "+Inf"]
                below = held[:-1].cumsum().tolist()
                family.add_metric(given, list(zip(names, below, strict=True)), float(held[-1]))
            elif isinstance(family, CounterMetricFamily):
                family.add_metric(given, float(held[0]))
        return family


class Cells:
    """The cells of this process, and the families that lie in them."""

    def __init__(self) -> None:
        self._families: list[Family] = []
        self._used = 0
        folder = os.environ.get("PROMETHEUS_MULTIPROC_DIR")
        self._folder = Path(folder) if folder else None
        self.held = memoryview(self._map()).cast("d")

    def family(
        self,
        name: str,
        help: str,
        label: str | None = None,
        values: tuple[str, ...] = ("",),
        bounds: tuple[float, ...] = (),
    ) -> Family:
        made = Family(name, help, self._used, label, values, bounds)
        self._used += made.width * len(values)
        assert self._used <= SIZE
        self._families.append(made)
        return made

    def observe(self, first: int, bounds: tuple[float, ...], value: float) -> None:
        """Adds `value` to the histogram that begins at this cell."""
        held = self.held
        held[first + bisect_left(bounds, value)] += 1.0
        held[first + len(bounds) + 1] += value

    def collect(self) -> Iterator[Metric]:
        """The counts of all processes together."""
        held = [self.held.tobytes()]
        if self._folder is not None:
            held = [file.read_bytes() for file in self._folder.glob("*.cells")]
        cells = np.sum([np.frombuffer(content) for content in held if len(content) == SIZE * 8], axis=0)
        for family in self._families:
            yield family.metric(cells)

    def _map(self) -> mmap.mmap:
        if self._folder is None:
            return mmap.mmap(-1, SIZE * 8)
        with open(self._folder / f"{os.getpid()}.cells", "ab+", opener=private) as file:
            file.truncate(SIZE * 8)  # keeps the counts of an earlier process with the same number
            return mmap.mmap(file.fileno(), SIZE * 8)
