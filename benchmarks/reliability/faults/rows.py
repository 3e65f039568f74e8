"""Every fault, again and again, while robots drive: python -m benchmarks.reliability faults.

Each row is a function of a `Scene`, its docstring the words for it. Its figures are written as soon as it is
done, so a run that was cut off goes on with `--resume`.
"""

from __future__ import annotations

import shutil
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.reliability.faults import disk, kills, machines, races, training
from benchmarks.reliability.faults.kills import Scene
from benchmarks.reliability.figures import about, read, write
from benchmarks.reliability.plant import Service
from benchmarks.reliability.robots import find_starts

Row = Callable[[Scene], dict[str, Any]]
ROWS: dict[str, Row] = {
    row.__name__: row
    for row in (
        kills.server_embedded,
        kills.server_redis,
        kills.store_embedded,
        kills.keeper,
        kills.redis_restarted,
        kills.store_stopped,
        kills.sigterm,
        kills.workers,
        races.replicas,
        races.same_step,
        races.different_steps,
        races.creates,
        training.run_killed,
        training.worker_killed,
        disk.disk_full,
        machines.cluster_node,
        machines.cluster_slots,
        machines.sentinel,
        machines.archive,
    )
}


def run(out: Path, n: int, names: Sequence[str], resume: bool, command: str) -> int:
    """How many rows could not be run to their end. n: faults a row."""
    failed = 0
    scratch = Path(tempfile.mkdtemp(prefix="rel-"))  # short: a unix socket's path has to be
    try:
        with Service(scratch / "reference") as reference:
            starts = find_starts(reference.url, 12)
            for i, name in enumerate(names):
                kept = read(out, f"fault-{name}")
                if resume and kept is not None and kept["n"] >= n and "failed" not in kept:
                    print(f"{name}: there already", flush=True)
                    continue
                folder = scratch / str(i)
                folder.mkdir()
                began, figures = time.monotonic(), {"row": name, "n": n, "what": _words(ROWS[name])}
                try:
                    figures |= ROWS[name](Scene(n, folder, reference.url, starts))
                except Exception as error:
                    traceback.print_exc()
                    _keep_logs(folder, out / f"failed-{name}")
                    figures["failed"] = f"{type(error).__name__}: {error}"[:1000]
                    failed += 1
                figures |= {"seconds": round(time.monotonic() - began, 1), **about(command)}
                write(out, f"fault-{name}", figures)
                shown = {
                    k: v for k, v in figures.items() if k not in ("what", "machine", "command", "commit")
                }
                print(f"{name}: {shown}", flush=True)
                shutil.rmtree(folder, ignore_errors=True)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return failed


def _keep_logs(folder: Path, into: Path) -> None:
    """What the servers and stores of a row said, for whoever looks for the cause."""
    shutil.rmtree(into, ignore_errors=True)
    into.mkdir(parents=True)
    for log in folder.rglob("*.log"):
        shutil.copy(log, into / "-".join(log.relative_to(folder).parts))


def _words(row: Row) -> str:
    return " ".join((row.__doc__ or "").split())
