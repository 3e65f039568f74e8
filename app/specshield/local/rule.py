"""A rule, present or earlier, of a session in this process."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from specshield import episode
from specshield.arrays import Floats
from specshield.client.models import SpecStatus
from specshield.episode.handover import rule_told
from specshield.errors import InputError
from specshield.shield.decision import Shield

if TYPE_CHECKING:
    from specshield.local.shield import LocalShield

CLOCKS = ("keep", "restart")


@dataclass(frozen=True)
class Rule:
    """begins: the first step that the rule decides. origin: the step from which its windows and its history
    count. shield: with the session's settings; like the core, it counts steps from `origin`.
    """

    policy: LocalShield
    shield: Shield
    begins: int = 0
    origin: int = 0
    clock: str = "restart"

    def followed_by(self, policy: LocalShield, shaping: str, t: int, clock: str) -> Rule:
        """The next rule, which begins at step t. As on a server, each origin has its own seed."""
        if clock not in CLOCKS:
            raise InputError("no such clock", path="clock", got=clock, expected=" or ".join(CLOCKS))
        origin, config = t if clock == "restart" else self.origin, self.shield.config
        last = max(self.shield.max_steps + self.origin, origin + policy.task.horizon + 1)
        settings = replace(config, seed=config.seed - self.origin + origin, max_steps=last - origin)
        return Rule(policy, policy.configured(settings, shaping), t, origin, clock)

    def verdict(self, rows: Floats, names: Iterable[str]) -> tuple[SpecStatus, tuple[float, float]]:
        """The verdict on a session's rows [n, 3 + signals], and the bounds on the rule's robustness."""
        if len(rows) <= self.origin:
            return "pending", (-math.inf, math.inf)
        since = rows[self.origin :]
        return episode.close(self.shield, since[:, :3], signals_in(since, names))


def signals_in(rows: Floats, names: Iterable[str]) -> dict[str, Floats]:
    """The samples [n] of each signal in rows [n, 3 + signals]. names: of the signals, by column."""
    return {name: rows[:, 3 + i] for i, name in enumerate(names)}


def told(rules: Sequence[Rule], rows: Floats, names: Sequence[str]) -> tuple[dict[str, Any], ...]:
    """The rules as the contract shows them, each with the verdict on the states to which it led."""
    seen = [*(rows[: rule.begins + 1] for rule in rules[1:]), rows]
    return tuple(
        rule_told(rule.policy.about(), rule.begins, rule.origin, rule.clock, rule.verdict(known, names)[0])
        for rule, known in zip(rules, seen, strict=True)
    )
