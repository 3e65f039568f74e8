"""What metrics and log cost a step [us of CPU]: in one process, and as one of several.

    python -m benchmarks.watch

Each figure is the least of five rounds, since the machine is shared.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

import numpy as np

CALLS = 20_000  # a round


def main() -> None:
    if len(sys.argv) > 1:
        measure()
        return
    with tempfile.TemporaryDirectory() as folder:
        for title, added in (("one process", {}), ("with --workers", {"PROMETHEUS_MULTIPROC_DIR": folder})):
            print(title, flush=True)
            command = [sys.executable, "-m", "benchmarks.watch", "measure"]
            subprocess.run(command, env={**os.environ, **added}, check=True, timeout=600)


def measure() -> None:
    from evaluation.shipped import shipped
    from specshield.episode import decide, make_shield
    from specshield.service import metrics
    from specshield.sim.cases import load_case

    shield = make_shield([shipped(load_case("case1"), "reachability")])
    decision = decide(shield, [[4.5, 5.0, 0.0]], np.zeros(20))._replace(residual=(0.0, 0.0))
    timing = {"rollout": 0.0003, "store": 0.0004}
    route = "/v1/sessions/{session_id}/steps"
    print(f"  metrics.decided   {cpu(lambda: metrics.decided(decision, 0, timing)):5.1f}")
    print(f"  metrics.answered  {cpu(lambda: metrics.answered('POST', route, 200, 0.001)):5.1f}")
    print(f"  /metrics          {cpu(lambda: metrics.exposition([]), 20):5.0f}")


def cpu(call: Callable[[], object], calls: int = CALLS) -> float:
    best = float("inf")
    for _ in range(5):
        start = time.process_time()
        for _ in range(calls):
            call()
        best = min(best, time.process_time() - start)
    return best / calls * 1e6


if __name__ == "__main__":
    main()
