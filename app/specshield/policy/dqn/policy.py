"""A trained pi_phi: its card, its weights, and what it proposes. Weights are safetensors, never pickles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from safetensors.numpy import save as save_tensors

from specshield.arrays import Floats, Ints
from specshield.errors import PolicyError
from specshield.policy.card import Card, Carded, joined
from specshield.policy.dqn.method import Settings
from specshield.policy.dqn.network import Network, make_network
from specshield.policy.dqn.observation import observation_size
from specshield.policy.dqn.rollout import propose_all
from specshield.policy.dqn.scene import Scene, make_scene
from specshield.policy.progress import make_rules, pasts
from specshield.policy.tensors import read_tensors
from specshield.policy.undo import undoing_motions
from specshield.robot.dynamics import Body, make_body, motion_count
from specshield.rule.values import signal_rows
from specshield.shield.proposal import Proposal
from specshield.task import Task


@dataclass(frozen=True, eq=False)
class Policy(Carded):
    """The greedy policy of a Q-network, pi_phi(x, t) = argmax_a Q(x, a, t), which also sees the progress.

    After the motion that it prefers, it proposes its own rollout. After another motion it proposes to undo
    that motion and to go the same way, if that satisfies the formula or its own rollout does not either, and
    else its own rollout.
    literal: its own rollout after every motion, as in the paper, which is slower, and J is 1 less often.
    """

    network: Network
    literal: bool = False

    @cached_property
    def scene(self) -> Scene:
        return make_scene(self.task)

    def on_body(self, body: Body, guess: bool = False) -> Policy:
        """The policy on another map: the distances it sees stay the same, its ways are simulated there."""
        other = replace(self)
        other.__dict__["scene"] = self.scene._replace(body=body)
        return other

    @cached_property
    def _undoing(self) -> Ints:
        return undoing_motions(self.task.robot)

    def propose(self, history: Floats, signals: Mapping[str, Floats], margin: float) -> Proposal:
        """As `Proposer` says."""
        rules = self.scene.rules
        scene = self.scene._replace(rules=rules._replace(signals=rules.signals.copy(), margin=margin))
        rows = signal_rows(self.task, signals, len(history))
        proposals = []
        for past in pasts(scene.rules, history, rows):
            motions = np.empty((len(self._undoing), self.task.horizon + 1 - len(history)), np.int64)
            preferred = propose_all(scene, self.network, past, self._undoing, self.literal, motions)
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


def check(task: Task, settings: Settings) -> None:
    """Raises what `train` would for a task that it cannot serve, without making anything."""
    make_rules(task)
    if task.horizon < 1:
        told = "there is nothing to learn: the rule looks at the first state alone"
        expected = "a horizon of at least 1; or method 'reachability'"
        raise PolicyError(told, path="spec.formula", got=str(task.formula), expected=expected)
