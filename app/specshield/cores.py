"""How many processors this process may use, which in a container is seldom how many the machine has."""

from __future__ import annotations

import math
import os
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")


def cores() -> int:
    """At least 1: what the scheduler allows this process, and no more than the share of its container."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        group = Path("/proc/self/cgroup").read_text().partition("0::/")[2].partition("\n")[0]
    except OSError:  # no Linux
        return allowed
    return math.ceil(min(allowed, share(CGROUPS, group)))


def share(root: Path, group: str) -> float:
    """How many processors a control group may use (cgroup v2): its own limit or the least of those of
    the groups that it lies in, inf without one. root: where they are mounted. group: its path below that.
    """
    least, folder = math.inf, root / group
    for each in (folder, *folder.parents):
        try:
            quota, period = (each / "cpu.max").read_text().split()
        except OSError:
            continue
        if quota != "max":
            least = min(least, int(quota) / int(period))
    return least
