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
        "What one plan may cost [about us]; a decision costs 2 to 3 times that. Over 150 steps of horizon it "
        "grows with the horizon's square: a way has more legs, and each costs more.",
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
