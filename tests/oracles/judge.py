"""Whether a case's rule was kept on a trajectory, by geometry and robustness of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from specshield import stl
from tests.oracles.brute_stl import brute_robustness


def margin(spec: Mapping[str, Any], poses: Sequence[Sequence[float]]) -> float:
    """rho of `spec`'s formula (as a request has it) on x_0, x_1, ...; beyond its horizon nothing counts."""
    formula = stl.parse(spec["formula"])
    samples = {
        name: [signed_distance(spec["regions"][name], x, y) for x, y, _ in poses] for name in formula.names
    }
    return brute_robustness(formula, samples)


def signed_distance(region: Mapping[str, Any], x: float, y: float) -> float:
    """Of a circle or a rectangle, positive inside."""
    if region["type"] == "circle":
        cx, cy = region["center"]
        return float(region["radius"]) - math.hypot(x - cx, y - cy)
    (x0, y0), (x1, y1) = region["min"], region["max"]
    outside = math.hypot(max(x0 - x, 0.0, x - x1), max(y0 - y, 0.0, y - y1))
    return -outside if outside > 0.0 else min(x - x0, x1 - x, y - y0, y1 - y)
