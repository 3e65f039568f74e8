"""A trained pi_phi: its card, its weights, and what it proposes. Weights are safetensors; nothing is
unpickled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save as save_tensors

from specshield.policy.card import Card
from specshield.policy.dqn.network import Network, make_network
from specshield.policy.dqn.observation import Sight, make_sight, observation_size
from specshield.policy.dqn.rollout import propose_all
from specshield.policy.tensors import read_tensors
from specshield.robot.dynamics import Body, make_body, motion_count, undoing_motions
from specshield.rule.progress import Rules, make_rules, pasts, signal_rows
from specshield.shield.proposal import Proposal, joined
from specshield.task import Task


@dataclass(frozen=True, eq=False)
class Policy:
    """A DQN's greedy policy pi_phi(x, t) = argmax_a Q(x, a, t), with the formula's progress in its
    observation.

    After the motion it prefers it proposes its own rollout; after another, to undo it and go the same way if
    that satisfies the formula, else its own rollout too. literal: its own rollout after every motion, as in
    the paper: slower, and J is less often 1.
    """

    task: Task
    card: Card
    network: Network
    literal: bool = False

    @property
    def id(self) -> str:
        return str(self.card["id"])

    @cached_property
    def _prepared(self) -> tuple[Body, Rules, Sight]:
        body, rules = make_body(self.task.robot, self.task.grid), make_rules(self.task)
        return body, rules, make_sight(self.task, rules, body)

    @cached_property
    def _undoing(self) -> NDArray[np.int64]:
        return undoing_motions(self.task.robot)

    def propose(
        self, history: NDArray[np.float64], signals: Mapping[str, NDArray[np.float64]], margin: float
    ) -> Proposal:
        body, rules, sight = self._prepared
        rules = rules._replace(signals=rules.signals.copy(), margin=margin)
        t, rows = len(history) - 1, signal_rows(self.task, signals, len(history))
        proposals = []
        for past in pasts(rules, history, rows):
            motions = np.empty((len(self.task.robot.motions), self.task.horizon - t), np.int64)
            poses = np.empty((*motions.shape, 3))
            preferred = propose_all(
                body, rules, sight, self.network, past, history, rows, self.task.robot.wait_motion,
                self._undoing, self.literal, motions, poses,
            )  # fmt: skip
            proposals.append(Proposal(motions, preferred))
        return joined(*proposals)

    def weights(self) -> bytes:
        """The safetensors file."""
        return save_tensors(self.network._asdict())


def load_dqn(weights: bytes | Path, card: Card, task: Task) -> Policy:
    """A policy from its two files. Raises PolicyError where the weights do not fit the task."""
    body, rules = make_body(task.robot, task.grid), make_rules(task)
    inputs, outputs = observation_size(rules, body), motion_count(body)
    return Policy(task, card, make_network(read_tensors(weights), inputs, outputs))
