"""What /metrics asks of the store when it is scraped: each server tells the same of all."""

from __future__ import annotations

import logging
import time

import anyio
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric

from specshield.errors import StoreError
from specshield.service.storage.connect import cause_of
from specshield.service.storage.store import Store
from specshield.service.training.jobs import Jobs

Kind = type[GaugeMetricFamily] | type[CounterMetricFamily]
KEPT_FOR = 2.0  # [s] for which the values of a scrape answer further ones; chosen by hand
log = logging.getLogger("specshield")


class Gauges:
    """Numbers of sessions and jobs, and the store's memory; only `specshield_store_up 0` while it is away."""

    def __init__(self, store: Store, jobs: Jobs) -> None:
        self._store, self._jobs = store, jobs
        self._asking = anyio.Lock()
        self._asked, self._found = -KEPT_FOR, list[Metric]()

    async def read(self) -> list[Metric]:
        """The families, at most KEPT_FOR old."""
        async with self._asking:  # of several scrapes at once, only one asks the store
            if time.monotonic() - self._asked > KEPT_FOR:
                try:
                    self._found = await self._families()
                except StoreError as error:
                    log.warning("/metrics tells nothing of the store now: %s%s", error, cause_of(error))
                    self._found = [_up(0)]
                self._asked = time.monotonic()
        return self._found

    async def _families(self) -> list[Metric]:
        sessions, held = await self._store.count(None), await self._store.held_bytes()
        waiting, ended = await anyio.to_thread.run_sync(self._jobs.counts)
        memory = GaugeMetricFamily("specshield_store_bytes", "Memory that the store takes.", held)
        return [
            _up(1),
            GaugeMetricFamily("specshield_sessions", "Sessions that the store holds.", sessions),
            *([] if held is None else [memory]),
            _by(GaugeMetricFamily, "specshield_jobs", "Jobs that wait or run.", waiting),
            _by(CounterMetricFamily, "specshield_jobs_ended", "Jobs that have ended.", ended),
        ]


def _up(value: int) -> Metric:
    return GaugeMetricFamily("specshield_store_up", "Whether the store answers.", value)


def _by(kind: Kind, name: str, help: str, counts: dict[tuple[str, str], int]) -> Metric:
    family = kind(name, help, labels=["method", "state"])
    for labels, count in counts.items():
        family.add_metric(labels, count)
    return family
