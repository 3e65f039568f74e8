"""A server that is not ready yet: what it says, whom it keeps waiting, and that it leaves nothing behind."""

import contextlib
import fcntl
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import numpy as np
import pytest

from specshield import compiled
from specshield.client import ShieldClient
from specshield.cores import cores
from specshield.errors import Starting, TransportError
from specshield.service.heavy.uploads import policies_of
from specshield.service.sessions.session import Session
from specshield.service.sessions.shields import Shields
from specshield.service.sessions.state import State
from specshield.service.settings import Settings
from specshield.service.startup import CHECK_EVERY, COMPLETE, KERNELS, NEARLY, READY, Startup
from specshield.shield.decision import Config
from tests.service.world import rule
from tests.serving import children, command_line, runs, serving, wait_for


@pytest.fixture
def held(tmp_path, monkeypatch):
    """A folder of kernels with none in it, and the lock that a server needs to compile them.

    They are for a processor that nobody has started a server for before.
    """
    kernels = tmp_path / "kernels"
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    monkeypatch.setattr(compiled.config, "CPU_NAME", "generic")
    kernels.mkdir()
    lock = os.open(kernels / f"{compiled.mark(READY).name}.lock", os.O_RDWR | os.O_CREAT)
    fcntl.flock(lock, fcntl.LOCK_EX)
    yield kernels, lock
    os.close(lock)


def test_a_server_takes_in_nothing_before_it_is_ready_that_no_first_decision_needs():
    """And the parent of several servers nothing of what they decide with."""
    parent = "import specshield.cli, uvicorn, specshield.service.leaving, specshield.service.storage.embedded"
    for imports, unneeded in (
        ("import specshield.service.app", "torch valkey specshield.lookahead.lookahead"),
        (parent, "torch valkey specshield.lookahead numba fastapi"),
    ):
        told = [sys.executable, "-c", f"{imports}; import sys; print(*sys.modules)"]
        modules = subprocess.run(told, check=True, capture_output=True, text=True).stdout.split()
        assert not set(unneeded.split()) & set(modules)


def alive(url):
    try:
        return httpx.get(f"{url}/livez", verify=False).status_code == 200
    except httpx.TransportError:
        return False


def starting(url):
    """Whether the client says so; on a busy machine the answers to all its tries may be late."""
    with ShieldClient(url, timeout=0.1) as client, contextlib.suppress(TransportError):
        try:
            client.policies.get("case1")
        except Starting:
            return True
        pytest.fail("it is ready")
    return False


def compiling(folder):
    """The processes that compile into it."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_bytes()
            environment = (process / "environ").read_bytes()
        except OSError:
            continue
        if b"specshield.service.warmup" in command and str(folder).encode() in environment:
            found.append(process)
    return found


def test_a_starting_server_says_how_far_it_is_and_leaves_nothing_running(tmp_path, held):
    kernels, lock = held
    with serving(tmp_path / "data", ready=False, NUMBA_CACHE_DIR=str(kernels)) as server:
        wait_for(lambda: alive(server.url))
        for path in ("/readyz", "/v1/policies", "/v1/sessions/none"):
            answer = httpx.get(f"{server.url}{path}", timeout=None, verify=False)
            assert answer.status_code == 503
            assert answer.headers["retry-after"] == "1"
            told = answer.json()
            assert told["type"] == "starting"
        for path in ("/livez", "/metrics", "/docs", "/openapi.json"):
            assert httpx.get(f"{server.url}{path}", timeout=None, verify=False).status_code == 200, path
        # Those of a server that was once started without NUMBA_CACHE_DIR are copied, and they count.
        copied = sum(1 for _ in compiled.SHIPPED.rglob("*.nbi"))
        assert told["kernels"]["compiled"] < copied + 10
        assert told["kernels"]["expected"] > 10
        assert told["parts"] == {"reachability": "compiling", "shield": "compiling"}
        wait_for(lambda: starting(server.url))
        fcntl.flock(lock, fcntl.LOCK_UN)
        wait_for(lambda: len(compiling(kernels)) == min(2, cores()))
        server.kill()
        wait_for(lambda: not compiling(kernels))
    assert re.search(r"INFO: +compiling the kernels that .* take about \d+ s", server.log.read_text())


def test_of_several_processes_none_that_is_not_ready_answers_once_the_server_is(tmp_path, incomplete):
    mark = incomplete / compiled.mark(READY).name

    def kill(pid):
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda: not runs(pid))

    def said(path):
        """By any of the processes: each request has a connection of its own."""
        return {httpx.get(f"{server.url}{path}", timeout=None, verify=False).status_code for _ in range(30)}

    def compiles():
        return server.log.read_text().count("compiling the kernels that are not on the disk")

    environment = {"NUMBA_CACHE_DIR": str(incomplete), "SPECSHIELD_COMPLETE": "false"}
    with serving(tmp_path / "data", "--workers", "2", **environment) as server:
        first, second = (pid for pid in children(server.process.pid) if "spawn_main" in command_line(pid))
        begun = compiles()
        with open(f"{mark}.lock", "ab") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            mark.unlink()
            kill(first)
            wait_for(lambda: compiles() == begun + 1)  # the process in its place
            time.sleep(NEARLY + CHECK_EVERY)
            assert said("/readyz") | said("/v1/sessions") == {200}
            kill(second)
            wait_for(lambda: alive(server.url) and said("/readyz") == said("/v1/sessions") == {503})
            mark.touch()
        wait_for(lambda: 200 in said("/readyz"))
        assert said("/readyz") | said("/v1/sessions") == {200}
        assert not compiling(incomplete)  # nor what few need, as it was told
    assert "in the background" not in server.log.read_text()


def test_what_an_earlier_start_compiled_counts(tmp_path, monkeypatch):
    """A first start that was killed, or sources that have changed where the kernels have not."""
    monkeypatch.setattr(compiled, "BASE", tmp_path)
    for i in range(3):
        (tmp_path / f"{i}.nbi").touch()
    problem = Startup(compiling=True).problem()
    assert problem.details["kernels"] == {"compiled": 3, "expected": KERNELS}
    assert f"3 of about {KERNELS} kernels are compiled" in str(problem)
    for i in range(KERNELS):
        (tmp_path / f"{i}.nbi").touch()
    assert "those of an earlier version are compiled anew" in str(Startup(compiling=True).problem())


@pytest.fixture
def incomplete(tmp_path):
    """The kernels of this checkout, but a small one of a planner and the word that none is missing."""
    kernels = tmp_path / "kernels"
    unfinished = "*.tmp.*"  # by another test
    shutil.copytree(compiled.BASE, kernels, ignore=shutil.ignore_patterns(f"{COMPLETE}-*", unfinished))
    without(kernels, "due_dates.make_bounds")
    return kernels


def without(kernels, name):
    """Takes a kernel away."""
    for file in kernels.rglob(f"{name}-*"):
        file.unlink()


def test_what_few_need_is_compiled_once_the_server_is_ready(tmp_path, incomplete):
    with serving(tmp_path / "data", NUMBA_CACHE_DIR=str(incomplete)):
        wait_for(lambda: list(incomplete.glob(f"{COMPLETE}-*[!k]")))
    assert list(incomplete.rglob("due_dates.make_bounds-*.nbi"))


def test_decisions_are_made_elsewhere_until_the_kernels_that_only_they_need_are_compiled(tmp_path):
    startup = Startup(completing=True)
    shields = Shields(policies_of(Settings(data_dir=tmp_path)), startup.has)
    learned, computed = (shields.policies.find(name, "").id for name in ("case1-dqn", "case1"))
    assert shields.slow_policies([learned])
    assert not shields.slow_policies([computed])
    settings, state = Config(threshold_over="episode"), State(0, 0, True, "pending", 0.0, b"")
    session = Session([rule(policy_ids=[computed])], settings, state, b"", np.empty((0, 3)), [], 0, 0)
    assert shields.slow(session, False)
    startup.completing = False  # as where it cannot be compiled
    assert not shields.slow(session, False)
    startup.completing = True
    assert shields.slow(session, False)
    startup.parts += ["dqn", "chances"]
    assert not shields.slow_policies([learned])
    assert not shields.slow(session, False)
    assert Startup().has("dqn")  # a server that is not to compile it


def test_a_server_told_to_stop_while_it_compiles_what_few_need_leaves_nothing_running(tmp_path, incomplete):
    without(incomplete, "first_motions.plan_all")  # which takes some seconds to compile
    with serving(tmp_path / "data", NUMBA_CACHE_DIR=str(incomplete)) as server:
        wait_for(lambda: compiling(incomplete))
        server.process.send_signal(signal.SIGTERM)
        wait_for(lambda: server.process.poll() is not None)
        wait_for(lambda: not compiling(incomplete))
    assert "Traceback" not in server.log.read_text()


def test_an_image_is_not_built_without_what_few_need(incomplete):
    digest = compiled.mark(COMPLETE).name
    (incomplete / f"{digest}.lock").mkdir()  # where a file has to be
    command = [sys.executable, "-m", "specshield.service.startup"]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(incomplete)}
    told = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert told.returncode == 1
    assert "the other kernels cannot be compiled now: IsADirectoryError" in told.stderr
    assert "Traceback" not in told.stderr


def test_a_disk_that_takes_no_kernel_is_not_taken_for_one_that_has_them_all(incomplete):
    told = subprocess.run(
        [sys.executable, "-m", "specshield.service.startup"],
        env={**os.environ, "NUMBA_CACHE_DIR": str(incomplete)}, capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (512, 512)),  # bytes of a file
    )  # fmt: skip
    assert told.returncode == 1
    assert "the kernels cannot be kept: " in told.stderr
    assert not list(incomplete.glob(f"{COMPLETE}-*[!k]"))
