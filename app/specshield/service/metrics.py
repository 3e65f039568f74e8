"""What /metrics shows; of several server processes where `PROMETHEUS_MULTIPROC_DIR` is set (cli.py does)."""

from __future__ import annotations

import os

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest, multiprocess

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
SECONDS = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)

registry = CollectorRegistry()
requests = Counter(
    "specshield_requests", "Requests answered.", ["method", "route", "status"], registry=registry
)
request_seconds = Histogram(
    "specshield_request_seconds", "Time to answer.", ["method", "route"], buckets=SECONDS, registry=registry
)
decisions = Counter("specshield_decisions", "Steps decided, without replays.", ["mode"], registry=registry)
part_seconds = Histogram(
    "specshield_step_part_seconds", "Time of a step by part.", ["part"], buckets=SECONDS, registry=registry
)


def exposition() -> bytes:
    """Prometheus text format."""
    if "PROMETHEUS_MULTIPROC_DIR" in os.environ:
        every = CollectorRegistry()
        multiprocess.MultiProcessCollector(every)  # type: ignore[no-untyped-call]
        return generate_latest(every)
    return generate_latest(registry)
