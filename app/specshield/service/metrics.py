"""The counts and times of /metrics. docs/watch.md lists them, with those that come from the store.

If `PROMETHEUS_MULTIPROC_DIR` is set, as cli.py does for several server processes, /metrics has the sums over
all of them: each process writes to its own files there, which outlive it, so that no count ever decreases.
The counts of steps are in `Cells`, the others in prometheus_client.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Mapping
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import prometheus_client as prometheus
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, multiprocess
from prometheus_client.metrics_core import Metric

from specshield import __version__
from specshield.errors import tree
from specshield.service.watch import logs
from specshield.service.watch.cells import Cells
from specshield.shield.decision import Decision

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
SECONDS = tuple(float(f"{digit}e{power}") for power in range(-4, 1) for digit in (1, 2, 5))  # 0.1 ms to 5 s
MASS = (1e-4, 1e-3, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 1.0)
RESIDUAL = (1e-6, 1e-3, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # [m] and [rad]
MODES = ("prior", "shaped", "completion", "fallback", "violated")
REASONS = ("infeasible", "zero_prior_mass", "margin_unattainable")

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
decisions = cells.family("specshield_decisions", "Steps decided, without replays.", "mode", MODES)
reasons = cells.family("specshield_reasons", "Decisions that carry a reason.", "reason", REASONS)
uncertified = cells.family(
    "specshield_decisions_without_witness", "Decisions on a pending rule that certify no way to keep it."
)
replays = cells.family("specshield_replays", "Steps answered again from the store.")
passed_over = cells.family(
    "specshield_steps_passed_over", "Poses told later, of steps that a robot took without a decision."
)
part_seconds = cells.family(
    "specshield_step_part_seconds", "Time of a step by part.", "part", ("rollout", "store"), SECONDS
)
mass_ratio = cells.family(
    "specshield_feasible_mass_ratio", "Probability that the model gave to feasible actions.", bounds=MASS
)
residual_meters = cells.family(
    "specshield_residual_meters", "From a pose to the nearest one foreseen.", bounds=RESIDUAL
)
residual_radians = cells.family(
    "specshield_residual_radians", "From a heading to that of the nearest pose foreseen.", bounds=RESIDUAL
)
_MODE = {mode: decisions.cell(mode) for mode in MODES}
_REASON = {reason: reasons.cell(reason) for reason in REASONS}
_ROLLOUT, _STORE = part_seconds.cell("rollout"), part_seconds.cell("store")


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
    _held[replays.first] += 1.0


def decided(decision: Decision, told_later: int, timing: Mapping[str, float]) -> None:
    """Counts a decided step, and logs it at the level debug.

    told_later: how many poses before x_t came with it. timing: the seconds of `rollout` and `store`.
    """
    mass, residual = decision.feasible_mass, decision.residual
    _held[_MODE[decision.mode]] += 1.0
    if decision.reason is not None:
        _held[_REASON[decision.reason]] += 1.0
    if decision.witness is None and decision.mode != "prior":
        _held[uncertified.first] += 1.0
    if told_later > 0:
        _held[passed_over.first] += told_later
    if mass is not None:
        _observe(mass_ratio.first, MASS, mass)
    if residual is not None:
        _observe(residual_meters.first, RESIDUAL, residual[0])
        _observe(residual_radians.first, RESIDUAL, residual[1])
    _observe(_ROLLOUT, SECONDS, timing["rollout"])
    _observe(_STORE, SECONDS, timing["store"])
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
