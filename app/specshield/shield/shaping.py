"""The closest distribution to the model's own, in KL, that meets the specification: three closed forms.

pi* = argmin KL(pi || prior) subject to E_pi[J] >= threshold (paper, Problem 1). All take log-probabilities,
so that no large multiplier is ever exponentiated, and condition on not ending: a terminal action keeps
exactly its prior mass and takes no part (docs/architecture.md, the terminal token).

Only threshold = 1 with binary J carries a guarantee: a threshold holds per step, and 0.99 ** 150 = 0.22.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from specshield.arrays import Bools, Floats
from specshield.compiled import kernel, leaf
from specshield.errors import LogitsError
from specshield.portable import exp, inner
from specshield.robot import Robot


@kernel
def log_softmax(logits: Floats) -> Floats:
    """Log-probabilities of logits in which -inf means impossible. At least one is finite. Shape (A,)."""
    top = np.max(logits)
    result: Floats = logits - top - np.log(np.sum(np.exp(logits - top)))
    return result


def log_prior_of(robot: Robot, logits: ArrayLike | None, main_task_done: bool) -> Floats | None:
    """The model's log-probabilities [A]; None without logits once its task is done. Raises LogitsError."""
    n = len(robot.actions)
    if logits is None:
        if main_task_done:
            return None
        expected = f"{n} numbers; null once main_task_done is true"
        raise LogitsError("logits are missing", path="logits", got=None, expected=expected)
    array = np.asarray(logits, dtype=np.float64)
    if array.shape != (n,):
        got = array.shape[0] if array.ndim == 1 else list(array.shape)
        expected = f"{n}, one for each of {', '.join(robot.action_names)}"
        raise LogitsError("the wrong number of logits", path="logits", got=got, expected=expected)
    i = _wrong(array)
    if 0 <= i < n:
        wrong, expected = "a logit is NaN or +infinity", "a number, or null for -inf"
        raise LogitsError(wrong, path=f"logits[{i}]", got=str(array[i]), expected=expected)
    if i == n:
        expected = "at least one finite logit"
        raise LogitsError("every logit is null", path="logits", got="all null", expected=expected)
    return log_softmax(array)


@leaf
def _wrong(logits: Floats) -> int:
    """The first logit that is NaN or +infinity, by index; their number if all are -infinity; else -1."""
    ruled_out = 0
    for i in range(logits.shape[0]):
        if math.isnan(logits[i]) or logits[i] == math.inf:
            return i
        ruled_out += logits[i] == -math.inf
    return ruled_out if ruled_out == logits.shape[0] else -1


@kernel
def going_on(log_prior: Floats, terminal: Bools) -> tuple[Floats | None, float]:
    """(log-probabilities given that the model does not end, its probability of ending). Shapes (A,).

    None where it ends for certain.
    """
    ending = min(np.sum(np.exp(log_prior[terminal])), 1.0)  # a sum may be rounded up
    return conditional(log_prior, ~terminal), ending


@kernel
def conditional(log_prior: Floats, allowed: Bools) -> Floats | None:
    """Log-probabilities given that an allowed action is drawn; None where those have no mass. Shapes (A,)."""
    kept, some = log_prior.copy(), False
    for a in range(kept.shape[0]):  # numba takes a second to compile np.where
        if not allowed[a]:
            kept[a] = -np.inf
        some |= kept[a] > -np.inf
    return log_softmax(kept) if some else None


@kernel
def with_ending(body: Floats, log_prior: Floats, ending: float, terminal: Bools) -> Floats:
    """`body` given that the model does not end, and the prior's own mass on terminal actions. Shapes (A,)."""
    shares: Floats = (1.0 - ending) * body * ~terminal + np.exp(log_prior) * terminal
    return shares


@kernel
def feasible_mass(log_prior: Floats, feasible: Bools) -> float:
    """pi_FM(S_t): the prior's mass on the feasible actions, log_prior conditional on not ending."""
    return float(min(np.sum(np.exp(log_prior[feasible])), 1.0))


def restrict(log_prior: Floats, feasible: Bools) -> Floats | None:
    """Threshold 1: the prior on S_t, renormalised (the limit of eq. 16). None if it has no mass there."""
    kept = conditional(log_prior, feasible)
    return None if kept is None else exp(kept)


def soften(log_prior: Floats, feasible: Bools, threshold: float) -> Floats | None:
    """Binary J, threshold below 1: mass `threshold` on S_t, the rest off it, each in proportion to the prior.

    Unchanged where the prior has that much already; None where it has no mass on S_t.
    """
    if feasible_mass(log_prior, feasible) >= threshold:
        return exp(log_prior)
    on, off = restrict(log_prior, feasible), restrict(log_prior, ~feasible)
    if on is None or off is None:
        return on
    return threshold * on + (1.0 - threshold) * off


def tilt(log_prior: Floats, values: Floats, threshold: float) -> Floats | None:
    """Real-valued J: prior exp(lambda J) / Z with the smallest lambda >= 0 whose mean J reaches `threshold`.

    values: J of each action, shape (A,), -inf where nothing was evaluated: such an action gets no mass. None
    where the threshold is above max J on the prior's support; where it equals that maximum, the prior
    restricted to the actions that reach it.
    """
    wanted = np.isfinite(log_prior)
    support = wanted & np.isfinite(values)
    if not np.any(support):
        return None
    if not np.array_equal(wanted, support):
        log_prior = log_softmax(np.where(support, log_prior, -np.inf))
    highest = float(np.max(values[support]))
    if threshold > highest:
        return None
    if threshold == highest:
        return restrict(log_prior, support & (values == highest))
    gains = np.where(support, values - highest, 0.0)  # <= 0: the tilt never overflows

    def tilted(multiplier: float) -> Floats:
        return exp(log_softmax(log_prior + multiplier * gains))

    def short(multiplier: float) -> float:
        return float(inner(tilted(multiplier), gains)) - (threshold - highest)

    if short(0.0) >= 0.0:
        return exp(log_prior)
    low, high = 0.0, 1.0
    while short(high) < 0.0:  # the mean rises to `highest` > threshold, so this ends
        low, high = high, 2.0 * high
        if not np.isfinite(high):
            return restrict(log_prior, support & (values == highest))
    while True:  # bisect to the last float, keeping the end that meets the constraint
        middle = 0.5 * (low + high)
        if middle in (low, high):
            return tilted(high)
        low, high = (middle, high) if short(middle) < 0.0 else (low, middle)


@kernel
def divergence(distribution: Floats, log_prior: Floats) -> float | None:
    """KL(distribution || prior) in nats; None where it leaves the prior's support. Shapes (A,)."""
    total = 0.0
    for share, log_share in zip(distribution, log_prior):  # noqa: B905 - compiled
        if share > 0.0:
            if log_share == -np.inf:
                return None
            total += share * (np.log(share) - log_share)
    return max(total, 0.0)
