"""Limits the requests that a key may make in a second: two token buckets for each key, in each process."""

from __future__ import annotations

import math
import time

from specshield.errors import RateLimited
from specshield.service.access.keys import Key


class Rates:
    """Steps have their own bucket, so that the robots of a key go on whatever else the key is used for. A
    bucket is the number of requests that were left, at most those of a second, and when that was [s].
    """

    def __init__(self) -> None:
        self._buckets: dict[tuple[str, bool], tuple[float, float]] = {}  # by the key's name, and for steps

    def take(self, key: Key, step: bool) -> None:
        """Counts a request. Raises RateLimited, with the seconds to wait."""
        rate = key.requests
        if rate is None:
            return
        now, most = time.monotonic(), max(1.0, rate)
        left, then = self._buckets.get((key.name, step), (most, now))
        left = min(most, left + (now - then) * rate)
        if left < 1.0:
            raise RateLimited(
                f"the key {key.name!r} may make {rate:g} requests in a second",
                expected="the request again after Retry-After",
                retry_after=math.ceil((1.0 - left) / rate),
            )
        self._buckets[key.name, step] = left - 1.0, now
