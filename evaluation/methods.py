"""Ways to choose an action for a model that knows no rule, side by side behind one interface.

unmodified   the model's own draw
hcd, rcd     SafeDec's next-step decoding (decoding.py)
simplex      the model's draw where it is feasible, else the certified continuation takes over
paper        the paper's decision rule with our DQN alone, rolled out at every step; hard projection
ours         reachability and the learned pi_phi, witnesses handed on from step to step; hard projection
lookahead    ours, and once the rule has cost 1 nat, feasible actions weighted by what it will still cost
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from evaluation.decoding import HardDecoding, RobustDecoding
from specshield.episode import Carry, Decision, Shield, decide
from specshield.errors import InputError
from specshield.shield import shaping
from specshield.stl import Verdict
from specshield.task import Task

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Answer:
    """What a method makes of one step; A actions.

    distribution [A]: what the action is drawn from. action: the draw, a terminal one ends the main task.
    execute: what the robot runs; None: it stands still from here on. mode: one of MODES in statistics.py.
    spec_status: None where the method does not know. kl [nats]: from the model's own distribution.
    robustness: rho of the future that certifies `execute` [m].
    """

    distribution: Floats
    action: int
    execute: int | None
    mode: str
    reason: str | None = None
    spec_status: Verdict | None = None
    j_values: tuple[float | None, ...] = ()
    feasible_mass: float | None = None
    kl: float | None = None
    robustness: float | None = None


class Method(Protocol):
    """A method for one task; it remembers within an episode and not beyond."""

    def begin(self, seed: int) -> None:
        """A new episode. seed: of what a method draws by itself."""
        ...

    def act(self, history: Floats, logits: Floats | None, draw: float) -> Answer:
        """The step at t = len(history) - 1.

        history [t + 1, 3]: the poses seen; logits [A]: the model's, None once its task is over; draw: a
        uniform number that decides every draw of the step, so that methods can share it.
        """
        ...


class Decoding:
    """A draw from the model's logits, which `how` may change, looking one step ahead at most."""

    def __init__(self, task: Task, how: HardDecoding | RobustDecoding | None = None) -> None:
        self._terminal, self._how = task.robot.terminal, how

    def begin(self, seed: int) -> None:
        pass

    def act(self, history: Floats, logits: Floats | None, draw: float) -> Answer:
        if logits is None:  # the model has ended, and this method has nothing to go on with
            raise InputError("next-step decoding has no plan of its own", path="logits", got=None)
        changed = logits if self._how is None else self._how.decode(history, logits)
        log_prior = shaping.log_softmax(logits)
        distribution = np.exp(shaping.log_softmax(changed))
        action = drawn(distribution, draw)
        return Answer(
            distribution,
            action,
            None if self._terminal[action] else action,
            "prior" if np.array_equal(changed, logits) else "shaped",
            kl=shaping.divergence(distribution, log_prior),
        )


class Shielded:
    """The shield. carries: whether each decision's witnesses are handed to the next decision.

    A session that learns needs a caller who executes what the shield drew: it then takes its seed from the
    run, and not the draws that methods share.
    """

    def __init__(self, shield: Shield, carries: bool = True) -> None:
        self._shield, self._carries = shield, carries
        self._carry: Carry | None = None

    def begin(self, seed: int) -> None:
        self._carry = None
        self._shield = replace(self._shield, config=replace(self._shield.config, seed=seed))

    def act(self, history: Floats, logits: Floats | None, draw: float) -> Answer:
        decision = decide(self._shield, history, logits, logits is None, carry=self._carry)
        alone = (None,) * len(decision.carry.witnesses)
        self._carry = decision.carry if self._carries else decision.carry._replace(witnesses=alone)
        distribution, action, mode = self._chosen(decision, logits, draw)
        moves = decision.completion_action if self._shield.task.robot.terminal[action] else action
        return Answer(
            distribution=distribution,
            action=action,
            execute=moves,
            mode=mode,
            reason=decision.reason,
            spec_status=decision.spec_status,
            j_values=decision.j_values,
            feasible_mass=decision.feasible_mass,
            kl=None if logits is None else shaping.divergence(distribution, shaping.log_softmax(logits)),
            robustness=None if moves is None else decision.robustness[moves],
        )

    def _chosen(self, decision: Decision, logits: Floats | None, draw: float) -> tuple[Floats, int, str]:
        """The distribution, the action drawn and the mode."""
        if self._shield.config.uncertainty is not None:
            return decision.distribution, decision.action, decision.mode
        return decision.distribution, drawn(decision.distribution, draw), decision.mode


class Simplex(Shielded):
    """The model's own draw where it is feasible; otherwise the first action of the certified continuation."""

    def _chosen(self, decision: Decision, logits: Floats | None, draw: float) -> tuple[Floats, int, str]:
        if logits is None or decision.completion_action is None:
            return super()._chosen(decision, logits, draw)
        prior = np.exp(shaping.log_softmax(logits))
        kept = (np.array(decision.j_values) == 1.0) | self._shield.task.robot.terminal
        distribution = np.where(kept, prior, 0.0)
        distribution[decision.completion_action] += prior[~kept].sum()
        own = drawn(prior, draw)
        if kept[own]:
            return distribution, own, decision.mode
        mode = "switched" if decision.mode == "shaped" else decision.mode
        return distribution, decision.completion_action, mode


def drawn(distribution: Floats, draw: float) -> int:
    """The action that a uniform number picks from a distribution [A]."""
    edges = np.cumsum(distribution)
    picked = np.searchsorted(edges, draw * edges[-1], side="right")
    return int(min(picked, np.flatnonzero(distribution)[-1]))
