"""How many requests a second a key may make: two buckets of tokens a key, in the memory of each process."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from specshield.errors import RateLimited
from specshield.service.access.keys import Key


@dataclass
class Bucket:
    """Holds a second's worth of requests at most. level: what is left. at: when it was counted [s]."""

    level: float
    at: float


class Rates:
    """Steps have a bucket of their own: whatever else a key is used for, its robots go on."""

    def __init__(self) -> None:
        self._buckets: dict[tuple[str, bool], Bucket] = {}  # as many as there are keys, twice

    def take(self, key: Key, step: bool) -> None:
        """Raises RateLimited, with the seconds to wait."""
        rate = key.requests
        if rate is None:
            return
        now, most = time.monotonic(), max(1.0, rate)
        bucket = self._buckets.setdefault((key.name, step), Bucket(most, now))
        bucket.level = min(most, bucket.level + (now - bucket.at) * rate)
        bucket.at = now
        if bucket.level < 1.0:
            raise RateLimited(
                f"the key {key.name!r} may make {rate:g} requests a second",
                expected="to be asked again after Retry-After",
                retry_after=math.ceil((1.0 - bucket.level) / rate),
            )
        bucket.level -= 1.0
