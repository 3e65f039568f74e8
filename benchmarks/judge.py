"""Whether trajectories keep a spec, by geometry and robustness written anew: nothing of the shield's own
evaluator but the nodes that its parser makes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from specshield import stl

Floats = NDArray[np.float64]


class Judge:
    """regions: as a request has them, circles and rectangles."""

    def __init__(self, formula: str, regions: Mapping[str, Any]) -> None:
        self.formula, self.regions = stl.parse(formula), regions

    def keeps(self, trajectories: Floats) -> NDArray[np.bool_]:
        """trajectories [N, T + 1, 3] -> bool [N]: rho > 0."""
        samples = {name: distance(self.regions[name], trajectories) for name in self.formula.names}
        return _rho(self.formula, samples, 0) > 0.0


def distance(region: Mapping[str, Any], poses: Floats) -> Floats:
    """Signed, positive inside. poses [..., 3]."""
    x, y = poses[..., 0], poses[..., 1]
    if region["type"] == "circle":
        cx, cy = region["center"]
        return np.asarray(region["radius"] - np.hypot(x - cx, y - cy))
    (x0, y0), (x1, y1) = region["min"], region["max"]
    dx, dy = np.maximum(x0 - x, x - x1), np.maximum(y0 - y, y - y1)
    outside = np.hypot(np.maximum(dx, 0.0), np.maximum(dy, 0.0))
    return np.where(outside > 0.0, -outside, -np.maximum(dx, dy))


def _rho(node: stl.Formula, samples: Mapping[str, Floats], t: int) -> Floats:
    match node:
        case stl.Atom(name):
            return samples[name][:, t]
        case stl.Not(child):
            return -_rho(child, samples, t)
        case stl.And(children):
            return np.min([_rho(child, samples, t) for child in children], axis=0)
        case stl.Or(children):
            return np.max([_rho(child, samples, t) for child in children], axis=0)
        case stl.Always(a, b, child):
            return np.min([_rho(child, samples, t + k) for k in range(a, b + 1)], axis=0)
        case stl.Eventually(a, b, child):
            return np.max([_rho(child, samples, t + k) for k in range(a, b + 1)], axis=0)
    raise TypeError(node)
