"""How many requests a second a key may make: two buckets of tokens a key, in the memory of each process."""

from __future__ import annotations

import math
import time

from specshield.errors import RateLimited
from specshield.service.access.keys import Key


class Rates:
    """Steps have a bucket of their own: whatever else a key is used for, its robots go on. A bucket holds a
    second's worth of requests at most: what was left of them, and when that was [s].
    """

    def __init__(self) -> None:
        self._buckets: dict[tuple[str, bool], tuple[float, float]] = {}  # as many as there are keys, twice

    def take(self, key: Key, step: bool) -> None:
        """Raises RateLimited, with the seconds to wait."""
        rate = key.requests
        if rate is None:
            return
        now, most = time.monotonic(), max(1.0, rate)
        left, then = self._buckets.get((key.name, step), (most, now))
        left = min(most, left + (now - then) * rate)
        if left < 1.0:
            raise RateLimited(
                f"the key {key.name!r} may make {rate:g} requests a second",
                expected="to be asked again after Retry-After",
                retry_after=math.ceil((1.0 - left) / rate),
            )
        self._buckets[key.name, step] = left - 1.0, now
