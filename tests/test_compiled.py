"""Kernels on disk: those of an older source are never run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from specshield import compiled

INNER = "from specshield.compiled import inlined\n\n@inlined\ndef inner(x: int) -> int:\n    return x + {}\n"
OUTER = (
    "from specshield.compiled import leaf\nfrom specshield.inner import inner\n\n"
    "@leaf\ndef outer(x: int) -> int:\n    return inner(x)\n\n"
    "print(outer(1), sum(outer.stats.cache_hits.values()))\n"
)


def test_a_kernel_is_compiled_anew_when_one_that_it_is_made_of_changes(tmp_path):
    package, kept = tmp_path / "specshield", tmp_path / "kept"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "compiled.py").write_text(Path(compiled.__file__).read_text())
    (package / "outer.py").write_text(OUTER)

    def run():
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(kept)}
        answer = subprocess.run(
            [sys.executable, "-c", "import specshield.outer"],
            env=environment, cwd=tmp_path, capture_output=True, text=True, check=True,
        )  # fmt: skip
        value, hits = map(int, answer.stdout.split())
        return value, hits

    (package / "inner.py").write_text(INNER.format(1))
    assert run() == (2, 0)
    assert run() == (2, 1)  # from disk
    (package / "inner.py").write_text(INNER.format(5))
    assert run() == (6, 0)
    assert len(list((kept / "specshield.outer").iterdir())) == 1  # the old ones are gone
