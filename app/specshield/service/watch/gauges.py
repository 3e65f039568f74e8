"""What /metrics asks of the store when it is scraped: each server tells the same of all."""

from __future__ import annotations

import logging
import time
from collections.abc import AsyncIterator, Awaitable
from typing import TypeVar

import anyio
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric

from specshield.errors import StoreError
from specshield.service.storage.connect import cause_of
from specshield.service.storage.store import Store
from specshield.service.training.jobs import Jobs

Kind = type[GaugeMetricFamily] | type[CounterMetricFamily]
T = TypeVar("T")
KEPT_FOR = 2.0  # [s] for which the values of a scrape answer further ones; chosen by hand
log = logging.getLogger("specshield")


class Gauges:
    """Numbers of sessions and jobs, and the store's memory, as far as the store tells them."""

    def __init__(self, store: Store, jobs: Jobs) -> None:
        self._store, self._jobs = store, jobs
        self._asking = anyio.Lock()
        self._asked, self._found = -KEPT_FOR, list[Metric]()

    async def read(self) -> list[Metric]:
        """The families, at most KEPT_FOR old."""
        async with self._asking:  # of several scrapes at once, only one asks the store
            if time.monotonic() - self._asked > KEPT_FOR:
                self._found = [metric async for metric in self._families()]
                self._asked = time.monotonic()
        return self._found

    async def _families(self) -> AsyncIterator[Metric]:
        up = await _told(self._store.up()) or 0.0
        yield GaugeMetricFamily("specshield_store_up", "Share of the store's masters that take a write.", up)
        if up == 0.0:
            return
        if (sessions := await _told(self._store.count(None))) is not None:
            yield GaugeMetricFamily("specshield_sessions", "Sessions that the store holds.", sessions)
        if (held := await _told(self._store.held_bytes())) is not None:
            yield GaugeMetricFamily("specshield_store_bytes", "Memory that the store takes.", held)
        if (jobs := await _told(anyio.to_thread.run_sync(self._jobs.counts))) is not None:
            waiting, ended = jobs
            yield _by(GaugeMetricFamily, "specshield_jobs", "Jobs that wait or run.", waiting)
            yield _by(CounterMetricFamily, "specshield_jobs_ended", "Jobs that have ended.", ended)


async def _told(asked: Awaitable[T]) -> T | None:
    """What the store tells; None, with a line of the log, while it does not."""
    try:
        return await asked
    except StoreError as error:
        log.warning("/metrics does not tell all of the store now: %s%s", error, cause_of(error))
        return None


def _by(kind: Kind, name: str, help: str, counts: dict[tuple[str, str], int]) -> Metric:
    family = kind(name, help, labels=["method", "state"])
    for labels, count in counts.items():
        family.add_metric(labels, count)
    return family
