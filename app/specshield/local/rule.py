"""A rule, present or earlier, of a session in this process."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from specshield import episode
from specshield.arrays import Floats
from specshield.client.models import Pose, SpecStatus
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

    def since(self, poses: Sequence[Pose]) -> Floats:
        """The poses from the rule's origin on."""
        return np.array(poses[self.origin :]).reshape(-1, 3)

    def signals(self, held: Mapping[str, Sequence[float]], length: int | None = None) -> dict[str, Floats]:
        """The samples that the rule reads, from its origin to before step `length`."""
        return {name: np.array(held[name][self.origin : length]) for name in self.shield.task.signals}

    def verdict(
        self, poses: Sequence[Pose], held: Mapping[str, Sequence[float]]
    ) -> tuple[SpecStatus, tuple[float, float]]:
        if len(poses) <= self.origin:
            return "pending", (-math.inf, math.inf)
        return episode.close(self.shield, self.since(poses), self.signals(held, len(poses)))


def told(
    rules: Sequence[Rule], poses: Sequence[Pose], held: Mapping[str, Sequence[float]]
) -> tuple[dict[str, Any], ...]:
    """The rules as the contract shows them, each with the verdict on the states to which it led."""
    seen = [*(poses[: rule.begins + 1] for rule in rules[1:]), poses]
    return tuple(
        rule_told(rule.policy.about(), rule.begins, rule.origin, rule.clock, rule.verdict(known, held)[0])
        for rule, known in zip(rules, seen, strict=True)
    )
