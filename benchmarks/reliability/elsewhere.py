"""Other measurements of benchmarks/ that docs/reliability.md shows: run as they are, their words kept."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.reliability.figures import ROOT, about, read, write

MODULES = {
    "step_cost": "what a step costs beside a bare FastAPI route",
    "archive": "a million steps archived and read back",
    "away": 'the rule under `on_failure="witness"` with the service away',
    "deadline": "the SDK's deadline against servers that misbehave",
}
MOST = 3 * 3600.0  # [s] of one of them


def run(out: Path, names: Sequence[str], resume: bool) -> int:
    """How many ended with another status than 0."""
    failed = 0
    for name in names:
        if importlib.util.find_spec(f"benchmarks.{name}") is None or (resume and read(out, name)):
            print(f"{name}: there already, or no such module", flush=True)
            continue
        began = time.monotonic()
        command = [sys.executable, "-m", f"benchmarks.{name}"]
        done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=MOST, check=False)
        print(done.stdout, flush=True)
        figures = {
            "status": done.returncode,
            "seconds": round(time.monotonic() - began),
            "what": MODULES[name],
        }
        said = {"lines": done.stdout.splitlines()[-60:]}
        write(out, name, {**figures, **said, **about(f"python -m benchmarks.{name}")})
        failed += done.returncode != 0
    return failed
