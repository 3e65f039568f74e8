"""Kernels on disk: those of an older source are never run."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from specshield import compiled

INNER = "from specshield.compiled import inlined\n\n@inlined\ndef inner(x: int) -> int:\n    return x + {}\n"
OUTER = (
    "from specshield.compiled import leaf\nfrom specshield.inner import inner\n\n"
    "@leaf\ndef outer(x: int) -> int:\n    return inner(x)\n\n"
    "print(outer(1), sum(outer.stats.cache_hits.values()))\n"
)
CALLEE = "from specshield.compiled import leaf\n\n@leaf\ndef inner(x: int) -> int:\n    return x + {}\n"
CALLER = (
    "from specshield import linking\nfrom specshield.compiled import leaf\n"
    "from specshield.inner import inner\n\nlinking.LONG = 0\n\n"
    "@leaf\ndef outer(x: int) -> int:\n    return inner(x)\n\n"
    "found = [outer, *(callee for place, callee in linking._callees.items() if 'inner' in place)]\n"
    "print(outer(1), sum(sum(kernel.stats.cache_hits.values()) for kernel in found))\n"
)
ANY = "from specshield.compiled import leaf\n\n@leaf\ndef first(pair):\n    return pair[0]\n"
PAIR = "from typing import NamedTuple\n\nclass Pair(NamedTuple):\n    left: int\n    right: int\n"
WITH_PAIR = (
    "from specshield.inner import first\nfrom specshield.{} import Pair\n\n"
    "print(first(Pair(2, 3)), sum(first.stats.cache_hits.values()))\n"
)


@pytest.fixture
def package(tmp_path):
    """A package of this name with one kernel that calls another, and with the true
    compiled.py and linking.py."""
    package = tmp_path / "first" / "specshield"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    for name in ("compiled.py", "linking.py"):
        (package / name).write_text(Path(compiled.__file__).with_name(name).read_text())
    (package / "outer.py").write_text(OUTER)
    (package / "inner.py").write_text(INNER.format(1))
    return package


# A process for each connection, forked where numba is imported with all that compiling imports, while
# nothing is compiled and nothing of this package is known: these imports take longer than what is tested.
FORKS = """
import gc, importlib, json, os, signal, socket, sys
import numba

def compiled():
    before = {*sys.modules}
    numba.njit(lambda x: x + 1)(1)
    print(*sorted({*sys.modules} - before))

heard, told = os.pipe()
if os.fork() == 0:
    os.dup2(told, 1)
    compiled()
    sys.stdout.flush()
    os._exit(0)
os.close(told)
with open(heard) as names:
    for name in names.read().split():
        importlib.import_module(name)
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
gc.freeze()
sys.dont_write_bytecode = True  # which goes by size and second: a source is edited sooner
print("ready", flush=True)
server = socket.socket(fileno=os.dup(0))
while True:
    connection, _ = server.accept()
    if os.fork() == 0:
        asked = json.loads(connection.makefile().readline())
        os.dup2(connection.fileno(), 1)
        os.dup2(connection.fileno(), 2)
        os.environ.clear()
        os.environ.update(asked["environment"])
        numba.core.config.reload_config()
        sys.path.insert(0, asked["path"])
        exec(asked["code"])
        sys.exit()
    connection.close()
"""
Python = Callable[..., str]


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Python]:
    """python(code, path, **variables): what Python prints, which looks for modules in `path` first."""
    address = str(tmp_path_factory.mktemp("forks") / "socket")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(address)
        server.listen()
        process = subprocess.Popen([sys.executable, "-c", FORKS], stdin=server, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"

    def python(code: str, path: Path, **variables: str) -> str:
        environment = {**os.environ, "PYTHONPATH": str(path), **variables}
        asked = {"code": code, "path": str(path), "environment": environment}
        with socket.socket(socket.AF_UNIX) as connection, connection.makefile("rw") as stream:
            connection.connect(address)
            print(json.dumps(asked), file=stream, flush=True)
            return stream.read()

    yield python
    process.kill()
    process.wait()
    process.stdout.close()


@pytest.fixture
def run(python: Python) -> Callable[..., tuple[int, int]]:
    """run(package, kept): what the kernel returns, and how often it was taken from the disk."""

    def run(package: Path, kept: Path | str, **more: str) -> tuple[int, int]:
        said = python("import specshield.outer", package.parent, NUMBA_CACHE_DIR=str(kept), **more)
        assert len(said.split()) == 2, said
        value, hits = map(int, said.split())
        return value, hits

    return run


def test_a_kernel_is_compiled_anew_when_one_that_it_is_made_of_changes(package, run, tmp_path):
    kept = tmp_path / "kept"
    assert run(package, kept) == (2, 0)
    assert run(package, kept) == (2, 1)  # from disk
    (package / "inner.py").write_text(INNER.format(5))
    assert run(package, kept) == (6, 0)
    assert len(list((kept / "specshield.outer").iterdir())) == 1  # the old ones are gone


def test_a_kernel_that_was_kept_for_a_type_which_has_moved_is_compiled_anew(package, run, tmp_path):
    kept = tmp_path / "kept"
    (package / "inner.py").write_text(ANY)
    for module in ("pairs", "moved"):
        (package / f"{module}.py").write_text(PAIR)
        (package / "outer.py").write_text(WITH_PAIR.format(module))
        assert run(package, kept) == (2, 0)
        assert run(package, kept) == (2, 1)
        (package / f"{module}.py").unlink()


def test_kernels_that_a_wheel_brings_are_taken_wherever_and_whenever_it_is_installed(package, run, tmp_path):
    kept, installed = tmp_path / "kept", tmp_path / "second" / "specshield"
    assert run(package, kept) == (2, 0)
    shutil.copytree(package, installed, copy_function=shutil.copyfile)  # with other times
    shutil.copytree(kept, installed / "kernels")
    assert run(installed, "") == (2, 1)  # where they are: no folder is named
    assert run(installed, tmp_path / "another") == (2, 1)
    assert run(installed, "/dev/null/cannot-be-made") == (2, 1)
    (installed / "inner.py").write_text(INNER.format(5))
    assert run(installed, tmp_path / "another") == (6, 0)


def test_kernels_are_for_a_processor_that_nearly_all_machines_have(package, run, tmp_path):
    kept = tmp_path / "kept"
    assert run(package, kept, NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="") == (2, 0)
    assert run(package, kept, NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="") == (2, 1)
    assert run(package, kept) == (2, 0)  # others, for another processor


@pytest.fixture
def linked(package):
    """The same with a kernel that the other does not contain, but names."""
    (package / "outer.py").write_text(CALLER)
    (package / "inner.py").write_text(CALLEE.format(1))
    return package


def test_a_kernel_from_the_disk_finds_what_it_calls_even_where_that_is_gone(linked, run, tmp_path):
    kept = tmp_path / "kept"
    assert run(linked, kept) == (2, 0)
    assert run(linked, kept) == (2, 2)  # the caller loads what it calls
    for lost in ("*.nbc", "*.nb?", "*"):
        for file in [*(kept / "specshield.inner").rglob(lost)]:
            shutil.rmtree(file) if file.is_dir() else file.unlink(missing_ok=True)
        assert run(linked, kept) == (2, 1), lost
        assert run(linked, kept) == (2, 2), lost
    (linked / "inner.py").write_text(CALLEE.format(5))
    assert run(linked, kept) == (6, 0)


def test_processes_that_compile_at_the_same_time_call_what_any_of_them_compiled(linked, run, tmp_path):
    kept = tmp_path / "kept"
    with ThreadPoolExecutor() as threads:
        answers = [threads.submit(run, linked, kept) for _ in range(4)]
    assert {answer.result()[0] for answer in answers} == {2}
    assert run(linked, kept) == (2, 2)


def test_kernels_of_others_are_read_without_this_package(package, python, tmp_path):
    """What another program has compiled beside this package can be read where the package is not."""
    kernel = "import numba\n\n@numba.njit(cache=True)\ndef least(x):\n    return x.min()\n"
    (package.parent / "other.py").write_text(kernel)
    call = "import numpy as np, other; print(other.least(np.ones(2)), len(other.least.stats.cache_hits))"
    generic = {"NUMBA_CPU_NAME": "generic"}  # this package sets another, which is part of a cache's key
    told = [
        python(f"{first}; {call}", package.parent, NUMBA_CACHE_DIR=str(tmp_path / "kept"), **generic)
        for first in ("import specshield.compiled", "import sys; sys.modules['specshield'] = None")
    ]
    assert told == ["1.0 0\n", "1.0 1\n"]
