"""Simple methods, made of parts of the shield, that might do as well as the shield.

rule-first   the rule before the task: the certified continuation until the rule is decided, then the model
visits-first the certified continuation until what is to be visited was, then the shield
hcd+, rcd+   next-step decoding, and a plan for the time after the model's `end`
switching    the model until its own draw is not feasible, then the plan until an obligation is met
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evaluation.methods import Answer, Decoding, Floats, Shielded, drawn
from specshield.episode import Decision, Shield
from specshield.shield import shaping
from specshield.stl import SATISFIED_ABOVE, Always, conjuncts, robustness_bounds
from specshield.task import Task


class RuleFirst(Shielded):
    """The certified continuation until the rule is decided, and the model alone after that.

    While the rule is pending the model is asked, and its divergence counted, but its `end` has no mass.
    """

    def __init__(self, shield: Shield) -> None:
        super().__init__(shield)
        self._alone = Decoding(shield.task)

    def act(self, history: Floats, logits: Floats | None, draw: float) -> Answer:
        led = super().act(history, None, draw)
        if logits is None:
            return led
        if led.spec_status == "pending":
            return replace(led, kl=shaping.divergence(led.distribution, shaping.log_softmax(logits)))
        return replace(self._alone.act(history, logits, draw), spec_status=led.spec_status)


class VisitsFirst(Shielded):
    """The certified continuation until every conjunct but those of the form G is met, and then the shield.

    A rule to keep out of a place until late does not hold the model back once the visits are made.
    """

    def act(self, history: Floats, logits: Floats | None, draw: float) -> Answer:
        task = self._shield.task
        visits = sum(not isinstance(part, Always) for part in conjuncts(task.formula))
        if logits is None or met(task, history) >= visits:
            return super().act(history, logits, draw)
        led = super().act(history, None, draw)
        if led.spec_status != "pending":  # a visit was missed: what is left is kept as the shield keeps it
            return super().act(history, logits, draw)
        return replace(led, kl=shaping.divergence(led.distribution, shaping.log_softmax(logits)))


class Completed:
    """A decoding that stands still after `end`, followed by the shield's completion instead.

    From the step of the model's `end` on, the robot follows the certified continuation until the rule is
    decided; where none was found, it follows the policy's best try.
    """

    def __init__(self, decoding: Decoding, shield: Shield) -> None:
        self._decoding, self._completion = decoding, Shielded(shield)

    def begin(self, seed: int) -> None:
        self._decoding.begin(seed)
        self._completion.begin(seed)

    def act(self, history: Floats, logits: Floats | None, draw: float) -> Answer:
        if logits is None:
            return self._completion.act(history, None, draw)
        answer = self._decoding.act(history, logits, draw)
        if answer.execute is not None:
            return answer
        led = self._completion.act(history, None, draw)
        return replace(answer, execute=led.execute, spec_status=led.spec_status, robustness=led.robustness)


class Switching(Shielded):
    """The model's own draw as long as it is feasible; then the plan drives until it has met an obligation.

    A draw that would break a G at the very next step is only replaced, once, as Simplex replaces it: no
    obligation is late. While the plan drives, a terminal action keeps the mass that the model gives it.
    """

    def __init__(self, shield: Shield) -> None:
        super().__init__(shield)
        self._history: Floats = np.empty((0, 3))
        self._met_before: int | None = None  # obligations met when the plan took over; None: the model drives

    def begin(self, seed: int) -> None:
        super().begin(seed)
        self._met_before = None

    def act(self, history: Floats, logits: Floats | None, draw: float) -> Answer:
        self._history = history
        if self._met_before is not None and met(self._shield.task, history) > self._met_before:
            self._met_before = None
        return super().act(history, logits, draw)

    def _chosen(self, decision: Decision, logits: Floats | None, draw: float) -> tuple[Floats, int, str]:
        plan, terminal = decision.completion_action, self._shield.task.robot.terminal
        if logits is None or plan is None:
            return super()._chosen(decision, logits, draw)
        prior = np.exp(shaping.log_softmax(logits))
        mode = "switched" if decision.mode == "shaped" else decision.mode
        driven = np.where(terminal, prior, 0.0)
        driven[plan] += prior[~terminal].sum()
        if self._met_before is not None:
            return driven, drawn(driven, draw), mode
        kept = (np.array(decision.j_values) == 1.0) | terminal
        distribution = np.where(kept, prior, 0.0)
        distribution[plan] += prior[~kept].sum()
        own = drawn(prior, draw)
        if kept[own]:
            return distribution, own, decision.mode
        if not breaks_now(self._shield.task, self._history, decision.next_poses[own]):
            self._met_before = met(self._shield.task, self._history)
        return distribution, plan, mode


def met(task: Task, history: Floats) -> int:
    """How many conjuncts of the rule hold already, whatever follows; a G does not before its window ends."""
    prefix = task.samples(history)
    return sum(
        bool(robustness_bounds(part, {name: prefix[name] for name in part.names})[0] > SATISFIED_ABOVE)
        for part in conjuncts(task.formula)
    )


def breaks_now(task: Task, history: Floats, pose: Floats) -> bool:
    """Whether a robot that is at `pose` (3,) at the next step has broken a G of the rule by that."""
    prefix = task.samples(np.concatenate([history, pose[None]]))
    guards = [part for part in conjuncts(task.formula) if isinstance(part, Always)]
    return any(
        bool(robustness_bounds(part, {name: prefix[name] for name in part.names})[1] <= SATISFIED_ABOVE)
        for part in guards
    )
