"""Reachability as one of the methods: its options, and where its parts are."""

from __future__ import annotations

from dataclasses import dataclass

from specshield.policy.methods import Method, lazily
from specshield.policy.options import option


@dataclass(frozen=True)
class Settings:
    """What a caller may choose."""

    pitch: float = option(
        0.1, "Side of a cell of the lattice [m]; a third of it where the map is small.", low=0.02, high=1.0
    )
    beam: int = option(
        12, "How many poses the search near a deadline keeps for each motion.", low=1, high=256
    )


METHOD = Method(
    "Computed in seconds: the latest time at which each pose can still keep the rule. For conjunctions of "
    "`F[a,b]`, `G[a,b]` and `F[a,c] G[d,b]` over boolean combinations of predicates.",
    Settings,
    lazily("specshield.policy.reachability.policy:check"),
    lazily("specshield.policy.reachability.policy:synthesise"),
    lazily("specshield.policy.reachability.policy:load_reachability"),
)
