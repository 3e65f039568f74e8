"""What has been driven, what the signals are taken to hold, and where predicates then hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from specshield.arrays import Bools, Floats
from specshield.reasons.lateness import values_of
from specshield.stl import Formula
from specshield.task import Task

ROUNDING = 1e-9  # robustness above minus this counts as positive, since compiled code may round otherwise


@dataclass(frozen=True)
class Known:
    """What has been driven, and what the signals hold. history [t + 1, 3], empty where nothing is known."""

    task: Task
    history: Floats
    signals: Mapping[str, Floats]

    @property
    def now(self) -> int:
        return len(self.history) - 1

    @property
    def held(self) -> dict[str, float]:
        steps = max(len(self.history), 1)
        return {name: float(self.task.signal(name, self.signals, steps)[-1]) for name in self.task.signals}

    def constant(self, predicate: Formula, step: int) -> bool | None:
        """See `needs.Reader`."""
        if not predicate.names or not set(predicate.names) <= set(self.task.signals):
            return None
        held = bool(self.at(predicate, np.zeros((1, 3)))[0])
        before = self.past(predicate)[step:] if step < self.now else np.empty(0, np.bool_)
        return held if (before == held).all() else None

    def past(self, predicate: Formula) -> Bools:
        """Whether a predicate held at each of the steps 0 to t."""
        return self._holds(predicate, self.task.samples(self.history, self.signals), -ROUNDING)

    def at(self, predicate: Formula, poses: Floats, above: float = -ROUNDING) -> Bools:
        """Whether a predicate holds at poses [n, 3] to come: its robustness is above that."""
        held = {name: np.array([value]) for name, value in self.held.items()}
        return self._holds(predicate, self.task.samples(poses, held), above)

    def _holds(self, predicate: Formula, samples: Mapping[str, Floats], above: float) -> Bools:
        """Whether rho is above that at each step; True at all if the arithmetic is not finite at one."""
        each = {name: samples[name][:, None] for name in predicate.names}  # every step is a trajectory of one
        return np.asarray(values_of(predicate, each, np.inf) > above) if each else np.ones(1, np.bool_)
