"""Policies that tests of a module ask for again and again: nothing changes them, so each is made once."""

from __future__ import annotations

from specshield.policy.reachability import policy as reachability
from specshield.policy.reachability.policy import ReachabilityPolicy, Settings
from specshield.task import Task

_MADE: dict[tuple[str, Settings | None], ReachabilityPolicy] = {}


def synthesise(task: Task, settings: Settings | None = None) -> ReachabilityPolicy:
    """As that of reachability, with one policy for all tasks that mean the same."""
    key = task.content_hash, settings
    if key not in _MADE:
        _MADE[key] = reachability.synthesise(task, settings)
    return _MADE[key]
