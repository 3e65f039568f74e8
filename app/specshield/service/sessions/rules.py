"""The rules that a session has had (pure).

A session's stored config has one line of JSON for each rule. The first line is what the session began with.
Each switch adds a line: the whole new config, and in addition `from`, the first step that the rule decides;
`origin`, the step from which its windows count; `clock`, as the request had it; and `before`, the link of the
chain (record.py) that the switch follows, in hex. `way` holds the motions that the rule began with, in hex,
if a search found them and no policy did; else it is empty.

The rows have a column for each signal that a rule so far declares: those of the first rule in alphabetical
order, then those that each further rule adds.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from specshield.arrays import Floats
from specshield.episode import handover
from specshield.shield.decision import Carry

MOST_RULES = 256  # of one session; chosen by hand: every load of the session reads their lines
Config = Mapping[str, Any]


def read(content: bytes) -> list[Config]:
    """The config of each rule; the last one is in force."""
    return [json.loads(line) for line in content.split(b"\n")]


def begins(config: Config) -> int:
    """The first step that the rule decides."""
    return int(config.get("from", 0))


def origin(config: Config) -> int:
    """The step from which the rule's windows count, and its history."""
    return int(config.get("origin", 0))


def at(rules: Sequence[Config], t: int) -> int:
    """The index of the rule that decides, or decided, step t."""
    return max(i for i, config in enumerate(rules) if begins(config) <= t)


def added(names: Iterable[str], signals: Iterable[str]) -> list[str]:
    """The names of the columns that a rule with these signals adds to the columns `names`."""
    return sorted(set(signals) - set(names))


def signals_in(rows: Floats, names: Iterable[str]) -> dict[str, Floats]:
    """The samples [n] of each signal in rows [n, 3 + signals]. names: of the signals, by column."""
    return {name: rows[:, 3 + i] for i, name in enumerate(names)}


def widened(rows: Floats, names: Sequence[str], signals: Mapping[str, float]) -> Floats:
    """The rows with the columns that a rule with these signals adds, which hold their initial values."""
    first = [signals[name] for name in added(names, signals)]
    return np.hstack([rows, np.tile(first, (len(rows), 1))]) if first else rows


def carried_over(carry: Carry | None, old: Config, new: Config) -> Carry:
    """The memory that the first decision under the new rule gets from the last one under the old rule."""
    same_map, same_robot = old["map_id"] == new["map_id"], old["robot"] == new["robot"]
    t, later = begins(new) - origin(new), origin(new) - origin(old)
    return handover.carried_over(carry, same_map, same_robot, t, later)._replace(way=way(new))


def way(config: Config) -> bytes | None:
    """The way that the rule began with, if a search found it and no policy did."""
    return bytes.fromhex(config["way"]) if config.get("way") else None


def told(rules: Sequence[Config], verdicts: Sequence[str]) -> list[dict[str, Any]]:
    """The rules as the contract shows them. verdicts: one for each rule."""
    return [
        handover.rule_told(rule, begins(rule), origin(rule), rule.get("clock", "restart"), verdict)
        for rule, verdict in zip(rules, verdicts, strict=True)
    ]
