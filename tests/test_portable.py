"""What is decided on one processor is decided on another to the same bytes."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

from specshield.portable import solve

DECIDED = Path(__file__).with_name("decided.py")


def test_a_processor_without_wide_vectors_decides_the_same() -> None:
    narrow = {
        "NPY_DISABLE_CPU_FEATURES": " ".join(name for name in __cpu_dispatch__ if __cpu_features__[name]),
        "OPENBLAS_CORETYPE": "Prescott",
    }
    said = [
        subprocess.run(
            [sys.executable, DECIDED], env={**os.environ, **more}, capture_output=True, text=True, check=True
        ).stdout.splitlines()
        for more in ({}, narrow)
    ]
    assert len(said[0]) == 6
    assert said[0] == said[1]


def test_solve_is_what_linear_algebra_says() -> None:
    random = np.random.default_rng(0)
    for n in (1, 2, 4, 7):
        root = random.normal(size=(n, n))
        matrix, right = root @ root.T + 0.1 * np.eye(n), random.normal(size=n)
        np.testing.assert_allclose(solve(matrix, right), np.linalg.solve(matrix, right), rtol=1e-9)
