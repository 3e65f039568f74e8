"""Kernels on disk: those of an older source are never run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from specshield import compiled

INNER = "from specshield.compiled import inlined\n\n@inlined\ndef inner(x: int) -> int:\n    return x + {}\n"
OUTER = (
    "from specshield.compiled import leaf\nfrom specshield.inner import inner\n\n"
    "@leaf\ndef outer(x: int) -> int:\n    return inner(x)\n\n"
    "print(outer(1), sum(outer.stats.cache_hits.values()))\n"
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
