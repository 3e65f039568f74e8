"""Clocks and quantiles. The machine may be shared: each call is repeated, and its quickest run counts."""

from __future__ import annotations

import gc
import os
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

QUANTILES = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}


def quietest(call: Callable[[], object], repeats: int) -> float:
    """Seconds of the quickest of `repeats` calls."""
    best = float("inf")
    gc.disable()
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - began)
    gc.enable()
    return best


def summary(seconds: Sequence[float]) -> dict[str, float]:
    """Quantiles in milliseconds, and of how many calls."""
    values = np.percentile(np.asarray(seconds) * 1e3, list(QUANTILES.values()))
    return dict(zip(QUANTILES, values.tolist(), strict=True)) | {"calls": len(seconds)}


def one_core() -> None:
    """This process and its children on one core."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "unknown")
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
    }
