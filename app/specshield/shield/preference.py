"""What a session may prefer inside the feasible set, beside the model's own distribution.

A preference adds log-weights to the model's log-probabilities before these are restricted to S_t. It cannot
make an action feasible, so the guarantee does not rest on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from specshield.arrays import Bools, Floats


class Preference(Protocol):
    """A preference, prepared for one task. The object keeps no state: what it learns of a session is a
    *memory* of bytes, which the session stores with each step.
    """

    def begin(self) -> bytes:
        """The memory before the first step."""
        ...

    def step(
        self,
        memory: bytes,
        history: Floats,
        signals: Mapping[str, Floats],
        log_prior: Floats,
        feasible: Bools,
    ) -> tuple[bytes, Floats]:
        """The memory after x_t, and the log-weights [A].

        history [t + 1, 3] with t < T; signals {name: [t + 1]}; log_prior [A]: what the model says at x_t;
        feasible [A]: S_t.
        """
        ...
