"""What policies share, and the card of one: the JSON that says what it is for and how it was made."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from specshield.robot import robot_to_json
from specshield.robot.dynamics import Body, make_body
from specshield.shield.proposal import Proposal
from specshield.task import Task
from specshield.world.regions import region_to_json

Card = dict[str, Any]
FORMAT = 1  # the version of the card's members; no other version exists yet, so nothing reads it


@dataclass(frozen=True, eq=False)
class Carded:
    """Base of the policies that come with a card."""

    task: Task
    card: Card

    @property
    def id(self) -> str:
        return str(self.card["id"])

    @cached_property
    def _body(self) -> Body:
        return make_body(self.task.robot, self.task.grid)


def joined(*proposals: Proposal) -> Proposal:
    """The futures of all proposals as one proposal, which prefers what the first one prefers."""
    if len(proposals) == 1:
        return proposals[0]
    return Proposal(np.concatenate([each.motions for each in proposals]), proposals[0].preferred)


def policy_id(task_hash: str, method: str, options: Mapping[str, Any], seed: int) -> str:
    """sha256 over task, method, options and seed, as hex: whatever decides what the policy does."""
    content = {"task": task_hash, "method": method, "options": options, "seed": seed}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def make_card(
    task: Task,
    method: str,
    options: Mapping[str, Any],
    seed: int,
    metrics: Mapping[str, Any],
    spec: Mapping[str, Any] | None = None,
) -> Card:
    """The card of a policy.

    metrics: measured figures, among them `wall_time_s`. spec: the spec as the caller gave it; by default the
    canonical formula and every region that it uses, the map's rooms included.
    """
    if not spec:  # one that can be read without the map's rooms
        regions = {name: region_to_json(region) for name, region in task.regions.items()}
        spec = {"formula": str(task.formula), "regions": regions}
        spec |= {"signals": dict(task.signals)} if task.signals else {}
    return {
        "format": FORMAT,
        "id": policy_id(task.content_hash, method, options, seed),
        "method": method,
        "map_id": task.grid.content_hash,
        "robot": robot_to_json(task.robot),
        "spec": dict(spec),
        "task_hash": task.content_hash,
        "horizon": task.horizon,
        "options": dict(options),
        "seed": seed,
        "metrics": dict(metrics),
    }
