"""The distribution that answers a step, given what is certified of each action (Algorithm 1)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats
from specshield.portable import exp
from specshield.shield import shaping
from specshield.shield.certificate import Certified
from specshield.shield.decision import Mode, Reason, Shield


class Answer(NamedTuple):
    """conditional [A]: the model's log-probabilities given that it does not end; None if it surely ends."""

    distribution: Floats
    mode: Mode
    reason: Reason | None
    conditional: Floats | None = None


def answer_of(
    shield: Shield,
    log_prior: Floats | None,
    certified: Certified,
    main_task_done: bool,
    weights: Floats | None,
    chance: Floats | None,
    left: float,
) -> Answer:
    """Steps 4 to 6 of Algorithm 1. A terminal action keeps exactly its prior mass, and has none in
    `completion`.

    weights [A]: a preference's log-weights, which are added to the model's log-probabilities inside S_t.
    chance [A], left: V and d_t / V* of a threshold over the episode (caution/threshold.py).
    """
    terminal, any_feasible = shield.task.robot.terminal, certified.some
    said: Reason | None = "margin_unattainable" if certified.lowered else None
    completing = all_on(certified.completion, len(terminal))
    conditional, ending = (None, 0.0) if log_prior is None else shaping.going_on(log_prior, terminal)
    if main_task_done or log_prior is None:
        mode: Mode = "completion" if any_feasible else "fallback"
        return Answer(completing, mode, said if any_feasible else "infeasible", conditional)
    mode = "shaped" if any_feasible else "fallback"
    if conditional is None:  # the model ends for certain
        return Answer(exp(log_prior), mode, None if any_feasible else "infeasible")
    config, attainable = shield.config, any_feasible
    wanted = conditional if weights is None else conditional + weights
    if config.evaluation == "robustness":
        shaped = shaping.tilt(conditional, certified.values, config.threshold)
        attainable = bool(certified.values.max() >= config.threshold)
    elif chance is not None and chance.max() > 0.0:
        shaped = None
        if left > 1.0 - 1e-9:  # the best chance is asked for: of the actions that have it, those in S_t
            shaped = shaping.restrict(wanted, certified.feasible & (chance >= chance.max()))
        if shaped is None:
            shaped = shaping.tilt(conditional, chance, left * float(chance.max()))
    elif config.threshold == 1.0 or config.threshold_over == "episode":
        shaped = shaping.restrict(wanted, certified.feasible)
    else:
        shaped = shaping.soften(conditional, certified.feasible, config.threshold)
    mode = "shaped"
    if shaped is None:
        mode, said, shaped = "fallback", "zero_prior_mass" if attainable else "infeasible", completing
    return Answer(shaping.with_ending(shaped, log_prior, ending, terminal), mode, said, conditional)


def unmodified(shield: Shield, log_prior: Floats | None) -> Answer:
    """The prior. Without logits nothing is left to do: `end`, or the first action if there is no `end`."""
    if log_prior is not None:
        return Answer(exp(log_prior), "prior", None)
    terminal = shield.task.robot.terminal
    return Answer(all_on(int(np.argmax(terminal)), len(terminal)), "prior", None)


def all_on(action: int, count: int) -> Floats:
    """The distribution [count] that has all its mass on one action."""
    distribution = np.zeros(count)
    distribution[action] = 1.0
    return distribution
