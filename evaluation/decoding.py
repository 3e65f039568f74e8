"""SafeDec's constrained decoding changes the logits by the state after one step (Kapoor et al., 2025).

    HCD   logit_a = -inf                                  where f(x_t, a) itself violates
    RCD   logit_a = logit_a + beta exp(alpha rho(f(x_t, a)))

What a next state means for a rule with windows is not defined there; we read it as favourably as next-step
reasoning allows. It violates where the states so far and the next one leave some conjunct no chance,
whatever follows: the last step of a window that was missed, a step into what G forbids. A conjunct that is
lost is dropped, a broken G is enforced again. Its robustness is the smallest of the predicates that
are asked for at t + 1: those of a G in its window, and of an F in its window that has not been satisfied yet.
A terminal action stands still.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specshield.policy.progress import residuals
from specshield.policy.progress.obligations import Obligation, obligations
from specshield.robot.dynamics import make_body, motion_count, successors
from specshield.stl import SATISFIED_ABOVE, conjuncts, robustness, robustness_bounds
from specshield.task import Task

Floats = NDArray[np.float64]

# The best of 24 pairs, alpha 0.25 to 2 and beta 1 to 10,000, by runs that kept the rule (seed 77, 40 a case).
ALPHA = 0.5  # [1/m]
BETA = 1000.0


class _NextStates:
    """Where each action leads from a history."""

    def __init__(self, task: Task) -> None:
        self.task, self._body = task, make_body(task.robot, task.grid)

    def after(self, history: Floats) -> Floats:
        """[A, 3]."""
        poses = np.empty((motion_count(self._body), 3))
        successors(self._body, history[-1], poses)
        robot = self.task.robot
        return np.where(robot.terminal[:, None], history[-1], poses[robot.motion_of])


class HardDecoding:
    def __init__(self, task: Task) -> None:
        self._next = _NextStates(task)

    def decode(self, history: Floats, logits: Floats) -> Floats:
        """Logits [A], -inf where the next state violates; a conjunct that all of them violate masks none."""
        task, t = self._next.task, len(history) - 1
        if t >= task.horizon:
            return logits
        prefix = task.samples(history)
        after = self._next.after(history)
        joined = np.concatenate([np.broadcast_to(history, (len(after), *history.shape)), after[:, None]], 1)
        samples = task.samples(joined)
        if robustness_bounds(task.formula, prefix)[1] > SATISFIED_ABOVE:
            rule = task.formula
        else:
            left = next(iter(residuals(task.formula, prefix, t)), None)
            if left is None:
                return logits
            rule = left
        chance = np.ones(len(logits), bool)
        for conjunct in conjuncts(rule):
            _, high = robustness_bounds(conjunct, {name: samples[name] for name in conjunct.names})
            with_it = chance & (high > SATISFIED_ABOVE)
            chance = with_it if with_it.any() else chance  # lost whatever is done: the others still count
        return np.where(chance, logits, -np.inf)


class RobustDecoding:
    def __init__(self, task: Task, alpha: float = ALPHA, beta: float = BETA) -> None:
        self._next, self._alpha, self._beta = _NextStates(task), alpha, beta
        self._obligations = obligations(task.formula)

    def decode(self, history: Floats, logits: Floats) -> Floats:
        """Logits [A]; unchanged where nothing is asked for at the next step."""
        asked = [part for part in self._obligations if self._is_asked(part, history)]
        if not asked:
            return logits
        samples = self._next.task.samples(self._next.after(history)[:, None])
        rho = np.min([_now(part, samples) for part in asked], axis=0)
        reweighted: Floats = logits + self._beta * np.exp(self._alpha * rho)
        return reweighted

    def _is_asked(self, part: Obligation, history: Floats) -> bool:
        """Whether the obligation asks for its predicate at the step that follows."""
        t = len(history) - 1
        last = part.c1 + part.b if part.kind == "eventually_always" else part.b
        if not part.a <= t + 1 <= last:
            return False
        if part.kind != "eventually":
            return True
        seen = self._next.task.samples(history[part.a :, None])
        return not bool((_now(part, seen) > SATISFIED_ABOVE).any())


def _now(part: Obligation, samples: dict[str, Floats]) -> Floats:
    """The robustness of an obligation's predicate at single states, [N] for samples [N, 1]."""
    return robustness(part.predicate, {name: samples[name] for name in part.predicate.names})
