"""Where the figures of a run are kept: one JSON file for each part, in out/reliability/."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.timing import machine

ROOT = Path(__file__).parents[2]
OUT = ROOT / "out" / "reliability"


def about(command: str) -> dict[str, Any]:
    """The machine, the commit, the command and the time of a run."""
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "command": command,
        "commit": commit.stdout.strip() or "unknown",
        "machine": machine() | {"memory_gib": round(memory, 1)},
        "when": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
    }


def write(out: Path, name: str, figures: dict[str, Any]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    partial = out / f".{name}.json"
    partial.write_text(json.dumps(figures, indent=1) + "\n")
    partial.replace(out / f"{name}.json")


def read(out: Path, name: str) -> dict[str, Any] | None:
    path = out / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def spread(values: Sequence[float]) -> dict[str, float] | None:
    """Median, largest and number; None of nothing."""
    if not values:
        return None
    ordered = sorted(values)
    middle = len(ordered) // 2
    median = ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2
    return {"median": round(median, 4), "max": round(ordered[-1], 4), "count": len(ordered)}
