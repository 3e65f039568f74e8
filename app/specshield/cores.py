"""The number of processors that this process may use: in a container mostly fewer than the machine has."""

from __future__ import annotations

import math
import os
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")


def cores() -> int:
    """How many processors the scheduler allows this process, at most its container's share, at least 1."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        group = Path("/proc/self/cgroup").read_text().partition("0::/")[2].partition("\n")[0]
    except OSError:  # no Linux
        return allowed
    return math.ceil(min(allowed, share(CGROUPS, group)))


def share(root: Path, group: str) -> float:
    """How many processors a control group (cgroup v2) may use: the least limit of the group and of those that
    contain it, inf without any. root: where the groups are mounted. group: its path below that.
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
