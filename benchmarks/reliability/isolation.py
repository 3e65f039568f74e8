"""Every attack of benchmarks/attacks.py on a server of its own, while another robot steps.

Asked for: the robot's p99 at most twice its quiet p99 + 20 ms, and memory back within 10 % afterwards.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import attacks
from benchmarks.reliability.figures import about, read, write
from benchmarks.reliability.plant import Service

MORE_MS = 20.0  # beside twice the quiet p99


def run(out: Path, names: Sequence[str], resume: bool, command: str) -> int:
    """How many attacks were felt by more than was asked for."""
    kept = (read(out, "isolation") or {}) if resume else {}
    rows: dict[str, Any] = {row["attack"]: row for row in kept.get("rows", [])}
    for name in names:
        if name in rows:
            continue
        scratch = Path(tempfile.mkdtemp(prefix="rel-"))
        try:
            with Service(scratch / "data", SPECSHIELD_WORKER="true") as service:
                for row in attacks.measure(service.url, service.pid, [name]):
                    rows[name] = judged(row)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
        print(json.dumps(rows[name]), flush=True)
        write(out, "isolation", {"rows": list(rows.values()), **about(command)})
    return sum(not (row["isolated"] and row["memory_back"]) for row in rows.values())


def judged(row: dict[str, Any]) -> dict[str, Any]:
    limit = 2.0 * row["p99_quiet_ms"] + MORE_MS
    return {
        **row,
        "p99_limit_ms": round(limit, 1),
        "isolated": row["p99_attack_ms"] <= limit,
        "memory_back": row["memory_after_mb"] <= attacks.BACK * row["memory_before_mb"],
    }
