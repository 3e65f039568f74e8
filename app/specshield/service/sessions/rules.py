"""The rules that a session has had (pure).

A session's stored config is a line of JSON for each of its rules. The first line is what the session began
with. A switch adds a line: the whole config from then on, and beside it `from`, the first step that the rule
decides; `origin`, the step from which its windows count; `clock`, as it was asked for; `before`, the link of
the chain (record.py) that the switch follows, in hex. `way`: the motions that the rule began with, in hex,
where a search found them and no policy did; else empty.

The rows have a column for each signal that a rule so far declares: those of the first rule in alphabetical
order, then what each further one adds.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from specshield import handover
from specshield.arrays import Floats
from specshield.shield.decision import Carry

MOST_RULES = 256  # of one session; chosen by hand: every load of the session reads their lines
Config = Mapping[str, Any]


def read(content: bytes) -> list[Config]:
    """The config of each rule, the one in force last."""
    return [json.loads(line) for line in content.split(b"\n")]


def begins(config: Config) -> int:
    """The first step that the rule decides."""
    return int(config.get("from", 0))


def origin(config: Config) -> int:
    """The step from which the rule's windows count, and its history."""
    return int(config.get("origin", 0))


def at(rules: Sequence[Config], t: int) -> int:
    """Which rule decides, or decided, step t."""
    return max(i for i, config in enumerate(rules) if begins(config) <= t)


def added(names: Iterable[str], signals: Iterable[str]) -> list[str]:
    """The columns that a rule with these signals adds to the columns `names`."""
    return sorted(set(signals) - set(names))


def signals_in(rows: Floats, names: Iterable[str]) -> dict[str, Floats]:
    """What rows [n, 3 + signals] hold of these signals, [n] each. names: by column."""
    return {name: rows[:, 3 + i] for i, name in enumerate(names)}


def widened(rows: Floats, names: Sequence[str], signals: Mapping[str, float]) -> Floats:
    """The rows with the columns that a rule with these signals adds; they hold the initial values."""
    first = [signals[name] for name in added(names, signals)]
    return np.hstack([rows, np.tile(first, (len(rows), 1))]) if first else rows


def carried_over(carry: Carry | None, old: Config, new: Config) -> Carry:
    """What the last decision under the old rule hands to the first one under the new."""
    same_map, same_robot = old["map_id"] == new["map_id"], old["robot"] == new["robot"]
    t, later = begins(new) - origin(new), origin(new) - origin(old)
    return handover.carried_over(carry, same_map, same_robot, t, later)._replace(way=way(new))


def way(config: Config) -> bytes | None:
    """The way that the rule began with, where a search found one and no policy did."""
    return bytes.fromhex(config["way"]) if config.get("way") else None


def told(rules: Sequence[Config], verdicts: Sequence[str]) -> list[dict[str, Any]]:
    """The rules as the contract shows them; verdicts: of each."""
    return [
        handover.rule_told(rule, begins(rule), origin(rule), rule.get("clock", "restart"), verdict)
        for rule, verdict in zip(rules, verdicts, strict=True)
    ]
