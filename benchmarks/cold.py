"""Time to the first decision, in a process of its own: with no compiled kernels on disk, and with them.

python -m benchmarks.cold case1 dqn      # prints its times as JSON
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any


def measure(case: str, method: str) -> dict[str, Any]:
    """Seconds of each step to the first decision: {"none": ..., "on disk": ...}, by what is compiled."""
    with tempfile.TemporaryDirectory() as cache:
        return {"none": _run(case, method, cache), "on disk": _run(case, method, cache)}


def _run(case: str, method: str, cache: str) -> dict[str, float]:
    env = {**os.environ, "NUMBA_CACHE_DIR": cache, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "benchmarks.cold", case, method]
    done = subprocess.run(command, env=env, check=True, capture_output=True, text=True)
    times: dict[str, float] = json.loads(done.stdout)
    return times


def main(case_name: str, method: str) -> None:
    began = last = time.perf_counter()
    times: dict[str, float] = {}

    def lap(name: str) -> None:
        nonlocal last
        now = time.perf_counter()
        times[name], last = now - last, now

    import numpy as np

    from benchmarks.states import shipped_dqn
    from specshield.episode import decide, make_shield
    from specshield.policy.reachability import policy as reachability
    from specshield.sim.cases import load_case

    lap("import")
    case = load_case(case_name)
    policy = shipped_dqn(case) if method == "dqn" else reachability.synthesise(case.task)
    shield = make_shield([policy])
    lap("load" if method == "dqn" else "synthesis")
    decide(shield, [[4.5, 5.0, 0.0]], np.zeros(len(case.task.robot.actions)))
    lap("first decision")
    times["total"] = time.perf_counter() - began
    print(json.dumps(times))


if __name__ == "__main__":
    main(*sys.argv[1:])
