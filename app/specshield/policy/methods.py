"""Reading back a policy of any method."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from specshield.errors import PolicyError
from specshield.policy.card import Card
from specshield.policy.dqn.policy import Proposer, load_dqn
from specshield.policy.planner.policy import load_planner
from specshield.policy.reachability.policy import load_reachability
from specshield.task import Task

READERS: dict[str, Callable[[bytes | Path, Card, Task], Proposer]] = {
    "dqn": load_dqn,
    "planner": load_planner,
    "reachability": load_reachability,
}


def load_policy(weights: bytes | Path, card: Card, task: Task) -> Proposer:
    """A policy from its two files, for the task it was made for. Raises PolicyError where they do not fit."""
    if card.get("task_hash") != task.content_hash:
        raise PolicyError(
            "the policy was made for another task",
            path="card.task_hash",
            got=card.get("task_hash"),
            expected=task.content_hash,
        )
    read = READERS.get(str(card.get("method")))
    if read is None:
        raise PolicyError(
            "unknown method", path="card.method", got=card.get("method"), expected=f"one of {sorted(READERS)}"
        )
    return read(weights, card, task)
