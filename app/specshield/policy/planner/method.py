"""The planner as one of the methods: its options, and where its parts are."""

from __future__ import annotations

from dataclasses import dataclass

from specshield.policy.methods import Method, lazily
from specshield.policy.options import option


@dataclass(frozen=True)
class Settings:
    """What a caller may choose."""

    pitch: float = option(0.1, "Side of a cell of the lattice [m].", low=0.02, high=1.0)
    effort: float = option(
        10_000.0,
        "How long one plan may take, in microseconds, roughly; a decision takes 2 to 3 times as long. With a "
        "horizon above 150 steps, a plan takes longer, by the square of the horizon.",
        low=100.0,
        high=1e7,
    )


METHOD = Method(
    "Made in seconds for any formula; it searches for a plan at every decision, which then takes longer.",
    Settings,
    lazily("specshield.policy.planner.policy:check"),
    lazily("specshield.policy.planner.policy:synthesise"),
    lazily("specshield.policy.planner.policy:load_planner"),
)
