"""What of the history still matters to a formula: its obligations, and how far each of them has come."""

from specshield.policy.progress.rules import (
    ALWAYS,
    BROKEN,
    EVENTUALLY,
    EVENTUALLY_ALWAYS,
    PENDING,
    SETTLED,
    STACK,
    Rules,
    advance,
    make_rules,
    read_predicates,
    replay,
    value_count,
)

__all__ = [
    "ALWAYS", "BROKEN", "EVENTUALLY", "EVENTUALLY_ALWAYS", "PENDING", "SETTLED", "STACK", "Rules", "advance",
    "make_rules", "read_predicates", "replay", "value_count",
]  # fmt: skip
