"""The counts and times of /metrics. docs/watch.md lists them, with those that come from the store.

If `PROMETHEUS_MULTIPROC_DIR` is set, as cli.py does for several server processes, /metrics has the sums over
all of them: each process writes to its own files there, which outlive it, so that no count ever decreases.
The counts of steps are in `Cells`: they take 3 us of a step (`python -m benchmarks.watch`), and would take 24
with prometheus_client, whose files also hold names and times. The others are in prometheus_client.
"""

from __future__ import annotations

import logging
import mmap
import os
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import prometheus_client as prometheus
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, multiprocess
from prometheus_client.metrics_core import CounterMetricFamily, HistogramMetricFamily, Metric

from specshield import __version__
from specshield.arrays import Floats
from specshield.errors import tree
from specshield.service.storage.keeper import private
from specshield.service.watch import logs
from specshield.shield.decision import Decision

SIZE = 512  # cells; a page of memory
MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
SECONDS = tuple(float(f"{digit}e{power}") for power in range(-4, 1) for digit in (1, 2, 5))  # 0.1 ms to 5 s
MASS = (1e-4, 1e-3, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 1.0)
RESIDUAL = (1e-6, 1e-3, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # [m] and [rad]
MODES = ("prior", "shaped", "completion", "fallback", "violated")
REASONS = ("infeasible", "zero_prior_mass", "margin_unattainable")


class Family(NamedTuple):
    """A counter, or with `bounds` a histogram; with `label` one for each value of it.

    firsts: the first cell for each value. A counter has one cell. A histogram has one for each bucket, of
    which the last has no upper bound, and one for the sum.
    """

    name: str
    help: str
    label: str | None
    bounds: tuple[float, ...]
    firsts: Mapping[str, int]

    def metric(self, cells: Floats) -> Metric:
        labels = [] if self.label is None else [self.label]
        if not self.bounds:
            counter = CounterMetricFamily(self.name, self.help, labels=labels)
            for value, first in self.firsts.items():
                counter.add_metric([value], float(cells[first]))
            return counter
        histogram = HistogramMetricFamily(self.name, self.help, labels=labels)
        names = [*map(str, self.bounds), "+Inf"]
        for value, first in self.firsts.items():
            total = first + len(names)
            below = cells[first:total].cumsum().tolist()
            histogram.add_metric([value], list(zip(names, below, strict=True)), float(cells[total]))
        return histogram


class Cells:
    """Counts and histograms that survive the kill of a process: each has a file of float64 cells, mapped into
    memory, to which the thread of its event loop adds. Who answers /metrics sums the files of all.
    """

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
    ) -> dict[str, int]:
        """Makes a family, and returns its `firsts`."""
        width = len(bounds) + 2 if bounds else 1
        firsts = {value: self._used + i * width for i, value in enumerate(values)}
        self._used += width * len(values)
        assert self._used <= SIZE
        self._families.append(Family(name, help, label, bounds, firsts))
        return firsts

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


prometheus.disable_created_metrics()  # type: ignore[no-untyped-call]
registry = CollectorRegistry()
requests = Counter(
    "specshield_requests", "Requests answered.", ["method", "route", "status"], registry=registry
)
request_seconds = Histogram(
    "specshield_request_seconds", "Time to answer.", ["method", "route"], buckets=SECONDS, registry=registry
)
refusals = Counter("specshield_refusals", "Problem documents sent.", ["type"], registry=registry)
watchers = Gauge("specshield_watchers", "Open event streams.", registry=registry, multiprocess_mode="livesum")
build = Gauge(
    "specshield_build_info", "1, with the version.", ["version"], registry=registry, multiprocess_mode="max"
)
build.labels(__version__).set(1)
_refusal = {error.type: refusals.labels(error.type) for error in tree()}

cells = Cells()
_held, _observe = cells.held, cells.observe
_modes = cells.family("specshield_decisions", "Steps decided, without replays.", "mode", MODES)
_reasons = cells.family("specshield_reasons", "Decisions that carry a reason.", "reason", REASONS)
_uncertified = cells.family(
    "specshield_decisions_without_witness", "Decisions on a pending rule that certify no way to keep it."
)[""]
_replays = cells.family("specshield_replays", "Steps answered again from the store.")[""]
_passed_over = cells.family(
    "specshield_steps_passed_over", "Poses told later, of steps that a robot took without a decision."
)[""]
_rollout, _store = cells.family(
    "specshield_step_part_seconds", "Time of a step by part.", "part", ("rollout", "store"), SECONDS
).values()
_mass_ratio = cells.family(
    "specshield_feasible_mass_ratio", "Probability that the model gave to feasible actions.", bounds=MASS
)[""]
_residual_meters = cells.family(
    "specshield_residual_meters", "From a pose to the nearest one foreseen.", bounds=RESIDUAL
)[""]
_residual_radians = cells.family(
    "specshield_residual_radians", "From a heading to that of the nearest pose foreseen.", bounds=RESIDUAL
)[""]


@lru_cache(maxsize=1024)
def _request(method: str, route: str, status: int) -> tuple[Counter, Histogram]:
    return requests.labels(method, route, status), request_seconds.labels(method, route)


def answered(method: str, route: str, status: int, seconds: float) -> None:
    """Counts an answered request. route: its template, since a caller's paths must not become labels."""
    count, time = _request(method, route, status)
    count.inc()
    time.observe(seconds)


def refused(type: str) -> None:
    """Counts a problem document that was sent."""
    _refusal[type].inc()


def replayed() -> None:
    """Counts a step that was answered from the store."""
    _held[_replays] += 1.0


def decided(decision: Decision, told_later: int, timing: Mapping[str, float]) -> None:
    """Counts a decided step, and logs it at the level debug.

    told_later: how many poses before x_t came with it. timing: the seconds of `rollout` and `store`.
    """
    mass, residual = decision.feasible_mass, decision.residual
    _held[_modes[decision.mode]] += 1.0
    if decision.reason is not None:
        _held[_reasons[decision.reason]] += 1.0
    if decision.witness is None and decision.mode != "prior":
        _held[_uncertified] += 1.0
    if told_later > 0:
        _held[_passed_over] += told_later
    if mass is not None:
        _observe(_mass_ratio, MASS, mass)
    if residual is not None:
        _observe(_residual_meters, RESIDUAL, residual[0])
        _observe(_residual_radians, RESIDUAL, residual[1])
    _observe(_rollout, SECONDS, timing["rollout"])
    _observe(_store, SECONDS, timing["store"])
    if decision.finished:
        logs.tell("session finished", spec_status=decision.spec_status, t=decision.t)
    if logs.log.isEnabledFor(logging.DEBUG):
        ms = {f"{part}_ms": round(1000 * seconds, 3) for part, seconds in timing.items()}
        about = {name: getattr(decision, name) for name in ("t", "mode", "action_name", "feasible_mass")}
        logs.tell("decided", logging.DEBUG, **about, **ms)


def exposition(gauges: Iterable[Metric]) -> bytes:
    """The counts of all processes, and `gauges`, in Prometheus' text format."""
    several = "PROMETHEUS_MULTIPROC_DIR" in os.environ
    counted: Any = multiprocess.MultiProcessCollector(None) if several else registry  # type: ignore[no-untyped-call]
    every: Any = SimpleNamespace(collect=lambda: [*counted.collect(), *cells.collect(), *gauges])
    return prometheus.generate_latest(every)
