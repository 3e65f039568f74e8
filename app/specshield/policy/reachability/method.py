"""Reachability as one of the methods: its options, and where its parts are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from specshield.policy.methods import Made, Method, Run
from specshield.policy.options import option

if TYPE_CHECKING:
    from specshield.policy.card import Card
    from specshield.shield.proposal import Proposer
    from specshield.task import Task


@dataclass(frozen=True)
class Settings:
    """What a caller may choose."""

    pitch: float = option(
        0.1, "Side of a cell of the lattice [m]; a third of it where the map is small.", low=0.02, high=1.0
    )
    beam: int = option(
        12, "How many poses the search near a deadline keeps for each motion.", low=1, high=256
    )


def _check(task: Task, options: Settings) -> None:
    from specshield.policy.reachability import policy

    policy.check(task, options)


def _make(task: Task, options: Settings, run: Run) -> Made:
    from specshield.policy.reachability import policy

    return policy.synthesise(task, options, run.spec)


def _load(weights: bytes | Path, card: Card, task: Task) -> Proposer:
    from specshield.policy.reachability import policy

    return policy.load_reachability(weights, card, task)


METHOD = Method(
    "Computed in seconds: the latest time at which each pose can still keep the rule. For conjunctions of "
    "`F[a,b]`, `G[a,b]` and `F[a,c] G[d,b]` over boolean combinations of predicates.",
    Settings,
    _check,
    _make,
    _load,
)
