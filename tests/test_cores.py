"""A server, a training and a campaign start as many threads and processes as they may use cores."""

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from specshield.cores import cores, share


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux binds a process to cores")
def test_a_process_bound_to_a_core_has_one() -> None:
    bound = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})"
    code = f"{bound}; from specshield.cores import cores; print(cores())"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "1"
    # Here it may be fewer than the scheduler allows, where a container has a share of them.
    assert 1 <= cores() <= len(os.sched_getaffinity(0))


def test_the_tightest_limit_of_a_group_and_those_it_lies_in_holds(tmp_path: Path) -> None:
    pod = tmp_path / "kubepods" / "pod"
    pod.mkdir(parents=True)
    assert share(tmp_path, "kubepods/pod") == math.inf
    (pod / "cpu.max").write_text("max 100000\n")
    assert share(tmp_path, "kubepods/pod") == math.inf
    (pod.parent / "cpu.max").write_text("150000 100000\n")
    assert share(tmp_path, "kubepods/pod") == 1.5
    (pod / "cpu.max").write_text("50000 100000\n")
    assert share(tmp_path, "kubepods/pod") == 0.5
    assert share(tmp_path, "") == math.inf
