"""Kernels on disk: those of an older source are never run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
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


def run(package, kept, **more):
    """What the kernel returns, and how often it was taken from the disk."""
    environment = {**os.environ, "PYTHONPATH": str(package.parent), "NUMBA_CACHE_DIR": str(kept), **more}
    answer = subprocess.run(
        [sys.executable, "-c", "import specshield.outer"],
        env=environment, cwd=package.parent, capture_output=True, text=True, check=True,
    )  # fmt: skip
    value, hits = map(int, answer.stdout.split())
    return value, hits


def test_a_kernel_is_compiled_anew_when_one_that_it_is_made_of_changes(package, tmp_path):
    kept = tmp_path / "kept"
    assert run(package, kept) == (2, 0)
    assert run(package, kept) == (2, 1)  # from disk
    (package / "inner.py").write_text(INNER.format(5))
    assert run(package, kept) == (6, 0)
    assert len(list((kept / "specshield.outer").iterdir())) == 1  # the old ones are gone


def test_kernels_that_a_wheel_brings_are_taken_wherever_and_whenever_it_is_installed(package, tmp_path):
    kept, installed = tmp_path / "kept", tmp_path / "second" / "specshield"
    assert run(package, kept) == (2, 0)
    shutil.copytree(package, installed, copy_function=shutil.copyfile)  # with other times
    shutil.copytree(kept, installed / "kernels")
    assert run(installed, "") == (2, 1)  # where they are: no folder is named
    assert run(installed, tmp_path / "another") == (2, 1)
    assert run(installed, "/dev/null/cannot-be-made") == (2, 1)
    (installed / "inner.py").write_text(INNER.format(5))
    assert run(installed, tmp_path / "another") == (6, 0)


def test_kernels_are_for_a_processor_that_nearly_all_machines_have(package, tmp_path):
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


def test_a_kernel_from_the_disk_finds_what_it_calls_even_where_that_is_gone(linked, tmp_path):
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


def test_processes_that_compile_at_the_same_time_call_what_any_of_them_compiled(linked, tmp_path):
    kept = tmp_path / "kept"
    with ThreadPoolExecutor() as threads:
        answers = [threads.submit(run, linked, kept) for _ in range(4)]
    assert {answer.result()[0] for answer in answers} == {2}
    assert run(linked, kept) == (2, 2)


def test_kernels_of_others_are_read_without_this_package(package, tmp_path):
    """What another program has compiled beside this package can be read where the package is not."""
    kernel = "import numba\n\n@numba.njit(cache=True)\ndef least(x):\n    return x.min()\n"
    (package.parent / "other.py").write_text(kernel)
    call = "import numpy as np, other; print(other.least(np.ones(2)), len(other.least.stats.cache_hits))"
    environment = {**os.environ, "PYTHONPATH": str(package.parent), "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    environment["NUMBA_CPU_NAME"] = "generic"  # this package sets another, which is part of a cache's key
    told = []
    for first in ("import specshield.compiled", "import sys; sys.modules['specshield'] = None"):
        command = [sys.executable, "-c", f"{first}; {call}"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        told.append(done.stdout)
    assert told == ["1.0 0\n", "1.0 1\n"]
