"""The counts and times of /metrics. docs/watch.md lists them, with those that come from the store.

If `PROMETHEUS_MULTIPROC_DIR` is set, as cli.py does for several server processes, /metrics has the sums over
all of them: each process writes to its own files there, which outlive it, so that no count ever decreases.
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
from specshield.shield.decision import Decision

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
SECONDS = tuple(float(f"{digit}e{power}") for power in range(-4, 1) for digit in (1, 2, 5))  # 0.1 ms to 5 s
MASS = (1e-4, 1e-3, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 1.0)
RESIDUAL = (1e-6, 1e-3, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # [m] and [rad]
MODES = ("prior", "shaped", "completion", "fallback", "violated")
REASONS = ("infeasible", "zero_prior_mass", "margin_unattainable")


def _counter(name: str, help: str, *labels: str) -> Counter:
    return Counter(f"specshield_{name}", help, labels, registry=registry)


def _histogram(name: str, help: str, bounds: tuple[float, ...], *labels: str) -> Histogram:
    return Histogram(f"specshield_{name}", help, labels, buckets=bounds, registry=registry)


prometheus.disable_created_metrics()  # type: ignore[no-untyped-call]
registry = CollectorRegistry()
requests = _counter("requests", "Requests answered.", "method", "route", "status")
request_seconds = _histogram("request_seconds", "Time to answer.", SECONDS, "method", "route")
refusals = _counter("refusals", "Problem documents sent.", "type")
watchers = Gauge("specshield_watchers", "Open event streams.", registry=registry, multiprocess_mode="livesum")
build = Gauge(
    "specshield_build_info", "1, with the version.", ["version"], registry=registry, multiprocess_mode="max"
)
build.labels(__version__).set(1)
_refusal = {error.type: refusals.labels(error.type) for error in tree()}

_decisions = _counter("decisions", "Steps decided, without replays.", "mode")
_modes = {mode: _decisions.labels(mode) for mode in MODES}
_with_reason = _counter("reasons", "Decisions that carry a reason.", "reason")
_reasons = {reason: _with_reason.labels(reason) for reason in REASONS}
_uncertified = _counter(
    "decisions_without_witness", "Decisions on a pending rule that certify no way to keep it."
)
_replays = _counter("replays", "Steps answered again from the store.")
_passed_over = _counter(
    "steps_passed_over", "Poses told later, of steps that a robot took without a decision."
)
_parts = _histogram("step_part_seconds", "Time of a step by part.", SECONDS, "part")
_rollout, _store = _parts.labels("rollout"), _parts.labels("store")
_mass_ratio = _histogram("feasible_mass_ratio", "Probability that the model gave to feasible actions.", MASS)
_residual_meters = _histogram("residual_meters", "From a pose to the nearest one foreseen.", RESIDUAL)
_residual_radians = _histogram(
    "residual_radians", "From a heading to that of the nearest pose foreseen.", RESIDUAL
)


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
    _replays.inc()


def decided(decision: Decision, told_later: int, timing: Mapping[str, float]) -> None:
    """Counts a decided step, and logs it at the level debug.

    told_later: how many poses before x_t came with it. timing: the seconds of `rollout` and `store`.
    """
    mass, residual = decision.feasible_mass, decision.residual
    _modes[decision.mode].inc()
    if decision.reason is not None:
        _reasons[decision.reason].inc()
    if decision.witness is None and decision.mode != "prior":
        _uncertified.inc()
    if told_later > 0:
        _passed_over.inc(told_later)
    if mass is not None:
        _mass_ratio.observe(mass)
    if residual is not None:
        _residual_meters.observe(residual[0])
        _residual_radians.observe(residual[1])
    _rollout.observe(timing["rollout"])
    _store.observe(timing["store"])
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
    every: Any = SimpleNamespace(collect=lambda: [*counted.collect(), *gauges])
    return prometheus.generate_latest(every)
