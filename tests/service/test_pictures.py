"""The heat map of a policy: as fine as there is time for, however long a start takes."""

import itertools
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from specshield.robot import robot_from_json
from specshield.service.heavy.pictures import FINEST, kept_from, latest
from specshield.shield.decision import make_shield
from specshield.shield.proposal import Proposal
from specshield.task import Task, make_task
from specshield.world.occupancy import OccupancyGrid
from tests.service.world import ROBOT, cells
from tests.serving import wait_for

TASK = make_task(OccupancyGrid(cells(), 0.1), robot_from_json(ROBOT), "F[0,1] x > 2")


@dataclass(frozen=True, eq=False)
class Waits:
    """Proposes to wait; its process is killed at a call, as by the alarm at the end of its time."""

    task: Task
    killed_at: float = math.inf
    calls: itertools.count = field(default_factory=itertools.count)
    id: str = "waits"

    def propose(self, history, signals, margin):
        if next(self.calls) >= self.killed_at:
            signal.raise_signal(signal.SIGALRM)
        return Proposal(np.full((1, 1), self.task.robot.wait_motion), 0)


def heats(**options):
    return kept_from(make_shield([Waits(TASK, **options)]), math.inf)


def test_the_grids_become_finer_to_the_finest():
    every = list(heats())
    assert [share.shape for share, _, _ in every[:3]] == [(1, 1), (1, 1), (2, 2)]
    share, pitch, headings = every[-1]
    assert FINEST < pitch < 1.5 * FINEST
    assert headings == 4
    width = share.shape[1]
    assert np.nanmax(share[:, : width // 3]) == 0.0  # nothing within two steps of x > 2
    assert np.nanmin(share[:, -width // 3 :]) == 1.0
    assert np.isnan(share[0]).all()  # the wall


def test_where_the_formula_has_no_value_nothing_can_be_kept():
    xmin, _, xmax, _ = TASK.grid.bounds
    task = make_task(TASK.grid, TASK.robot, f"G[0,1] 1 / (x - {(xmin + xmax) / 2}) < 9")
    share, _, _ = next(kept_from(make_shield([Waits(task)]), math.inf))  # of the middle alone
    assert share == 0.0


def test_none_is_begun_that_would_come_too_late():
    assert [pitch for _, pitch, _ in kept_from(make_shield([Waits(TASK)]), time.monotonic())] == [4.0]


@pytest.mark.parametrize(("calls", "known"), [(0, False), (20, True)])
def test_what_there_is_when_the_time_is_over_is_shown(calls, known):
    found = latest(heats(killed_at=calls), 3600.0)
    assert (found is not None) == known
    if known:
        _, coarse, _ = found
        assert FINEST < coarse < 4.0


def test_a_value_that_never_comes_is_not_waited_for():
    def values():
        yield os.getpid()
        signal.setitimer(signal.ITIMER_REAL, 1e-3)  # the rest of its time, however slow the machine
        while True:
            pass

    assert latest(values(), 3600.0) != os.getpid()


def test_a_fork_that_fails_is_not_taken_for_one_that_had_no_more_time(capfd):
    with pytest.raises(MemoryError):
        latest((1 / n for n in (1, 0)), 3600.0)
    assert "ZeroDivisionError" in capfd.readouterr().err


def test_a_fork_ends_with_the_process_that_wants_its_values():
    """Whoever asks for a picture may go away, and then what draws it is killed."""
    code = (
        "import os, sys, time\n"
        "from specshield.service.heavy.pictures import latest\n"
        "def values():\n"
        "    yield os.getpid()\n"
        "    print(os.getpid(), flush=True)\n"
        "    time.sleep(7200)\n"
        "latest(values(), 7200.0)\n"
    )
    asking = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert asking.stdout is not None
    fork = int(asking.stdout.readline())
    asking.kill()
    asking.communicate()
    wait_for(lambda: not Path(f"/proc/{fork}").exists())  # it would be there for two hours
