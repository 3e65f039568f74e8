"""Poses that look like a mistake are taken, and said to look like one."""

import numpy as np
import pytest

from specshield.episode import decide, make_shield
from tests.oracles.cells import Cells, Scripted, waits

EVEN = np.zeros(5)


@pytest.mark.parametrize(
    ("poses", "said"),
    [
        ([[0.1, 0.1, 0.0], [0.3, 0.1, 3.1]], []),
        ([[0.1, 0.1, 6.28]], []),
        ([[0.1, 0.1, 90.0]], ["looks like degrees, which would be 1.571 radians"]),
        ([[0.1, 0.1, -180.0]], ["looks like degrees"]),
        ([[0.1, 0.1, 90.0], [0.1, 0.1, 0.0]], []),
        ([[0.1, 0.1, 0.0], [0.1, 64.0, 0.0]], ["off the map, which spans (0, 0) to (1, 1)", "is 63.9 m"]),
        ([[0.1, 0.1, 0.0], [0.9, 0.9, 0.0]], []),
    ],
)  # fmt: skip
def test_what_looks_odd_is_said(poses, said):
    cells = Cells("F[0,4] A", None, {"A": (2, 0)})
    warnings = decide(make_shield([Scripted(cells, waits)]), poses, EVEN).warnings
    assert len(warnings) == len(said)
    assert all(part in warning for part, warning in zip(said, warnings, strict=True))
