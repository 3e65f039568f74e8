"""Robustness rho of a formula: exact on whole trajectories, sound bounds on prefixes.

    rho(x > y, t)       = x(t) - y(t)                  rho(name, t)    = its sample at t
    rho(not f, t)       = -rho(f, t)                   rho(f -> g, t)  = max(-rho(f, t), rho(g, t))
    rho(f and g, t)     = min(rho(f, t), rho(g, t))    rho(f or g, t)  = max(rho(f, t), rho(g, t))
    rho(G[a,b] f, t)    = min of rho(f, t') over t' in [t+a, t+b];    F: max
    rho(f U[a,b] g, t)  = max over t' in [t+a, t+b] of
                          min(rho(g, t'), min of rho(f, t'') over t'' in [t, t'))

One evaluator computes both. Its arrays are [ends, *batch, time]. There is one end if every sample is known,
and two, the lower and the upper bound, if some are not. Every operator but `not` is monotone in its operands,
so it acts on each end alone; `not` swaps the ends. A sample that is still to come may be any real number, so
the bounds on a term come from interval arithmetic and are the same at every step to come.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from specshield.arrays import Floats
from specshield.errors import SampleError
from specshield.stl.formula import (
    Always,
    And,
    Arithmetic,
    Atom,
    Comparison,
    Eventually,
    Formula,
    Implies,
    Name,
    Not,
    Or,
    Term,
    Until,
)
from specshield.stl.terms import interval, value

SATISFIED_ABOVE = 0.0  # satisfied means rho > 0; rho = 0 is not satisfied

Verdict: TypeAlias = Literal["satisfied", "violated", "pending"]


def robustness(formula: Formula, samples: Mapping[str, ArrayLike]) -> Floats:
    """rho at step 0, shape [...], from samples [..., N] of each name, N >= horizon + 1.

    The names' batch shapes broadcast. Raises SampleError if a name is missing, if samples are too few, NaN or
    infinite, or if arithmetic on them is not finite (a division by zero, an overflow).
    """
    seen = _read(formula, samples)
    if seen.known <= formula.horizon:
        raise SampleError(
            f"{seen.known} samples are too few for a horizon of {formula.horizon}; a prefix only has bounds",
            got=seen.known,
            expected=f"at least {formula.horizon + 1} samples, steps 0 to {formula.horizon}",
        )
    return _bounds(formula, seen)[0]


def robustness_bounds(formula: Formula, prefix: Mapping[str, ArrayLike]) -> tuple[Floats, Floats]:
    """(lo, hi), each [...]: rho at step 0 lies in [lo, hi] however the samples [..., n] go on.

    Samples to come may be any real numbers, so a bound may be infinite. With n > horizon both bounds are the
    robustness, bit for bit. n may be 0. Raises SampleError as `robustness` does, but not for too few samples.
    """
    return _bounds(formula, _read(formula, prefix))


def unseen_bounds(formula: Formula) -> tuple[float, float]:
    """Bounds (lo, hi) on rho if every name may be any real number."""
    low, high = _bounds(formula, _Seen({name: np.empty(0) for name in formula.names}, (), 0))
    return float(low), float(high)


def verdict(formula: Formula, prefix: Mapping[str, ArrayLike], margin: float = SATISFIED_ABOVE) -> Verdict:
    """Whether the prefix of one trajectory, samples [n], decides that rho > margin [m].

    A verdict other than "pending" is the verdict on every continuation too.
    """
    low, high = robustness_bounds(formula, prefix)
    if low.ndim:
        raise SampleError(
            "a verdict is about one trajectory", got=list(low.shape), expected="samples of shape [n]"
        )
    return verdict_between(float(low), float(high), margin)


def verdict_between(low: float, high: float, margin: float = SATISFIED_ABOVE) -> Verdict:
    """What bounds on rho [m] say of a formula."""
    return "satisfied" if low > margin else "violated" if high <= margin else "pending"


@dataclass(frozen=True)
class _Seen:
    """The samples so far: `values` [*batch, known] of each name, at steps 0 to known - 1."""

    values: Mapping[str, Floats]
    batch: tuple[int, ...]
    known: int


def _read(formula: Formula, samples: Mapping[str, ArrayLike]) -> _Seen:
    missing = [name for name in formula.names if name not in samples]
    if missing:
        raise SampleError(
            f"there are no samples of {missing[0]}",
            path=missing[0],
            got=sorted(samples),
            expected=", ".join(formula.names),
        )
    arrays = {name: _sampled(name, samples[name]) for name in formula.names or samples}
    lengths = {name: array.shape[-1] for name, array in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise SampleError(
            "the names have samples of different lengths", got=lengths, expected="one length for all"
        )
    try:
        batch = np.broadcast_shapes(*(array.shape[:-1] for array in arrays.values()))
    except ValueError:
        shapes = {name: list(array.shape) for name, array in arrays.items()}
        raise SampleError(
            "the samples' batch shapes do not fit together", got=shapes, expected="shapes that broadcast"
        ) from None
    if not formula.names:  # a formula of constants alone is known at every step
        return _Seen({}, batch, formula.horizon + 1)
    known = next(iter(lengths.values()))
    return _Seen({name: np.broadcast_to(x, (*batch, known)) for name, x in arrays.items()}, batch, known)


def _sampled(name: str, samples: ArrayLike) -> Floats:
    array = np.asarray(samples)
    if array.dtype.kind not in "fiub" or array.ndim == 0:
        got = f"{array.dtype} of shape {list(array.shape)}"
        raise SampleError(
            f"the samples of {name} are not an array of numbers", path=name, got=got, expected="[..., n]"
        )
    array = array.astype(np.float64, copy=False)
    if not np.isfinite(array).all():
        where = tuple(np.argwhere(~np.isfinite(array))[0])
        raise SampleError(
            f"the sample of {name} at step {where[-1]} is {array[where]}",
            path=name,
            got=str(array[where]),
            expected="finite numbers",
            time=int(where[-1]),
        )
    return array


def _bounds(formula: Formula, seen: _Seen) -> tuple[Floats, Floats]:
    with np.errstate(all="ignore"):
        ends = _evaluate(formula, seen, 0, 1)[..., 0] + 0.0  # makes a copy, and 0.0 of -0.0
    return np.asarray(ends[0]), np.asarray(ends[-1])


def _evaluate(formula: Formula, seen: _Seen, start: int, stop: int) -> Floats:
    """rho at steps start to stop - 1. Shape [ends, *batch, stop - start]."""
    match formula:
        case Atom() | Comparison():
            return _predicate(formula, seen, start, stop)
        case Not(child):
            return -_evaluate(child, seen, start, stop)[::-1]
        case And(children):
            return reduce(np.minimum, (_evaluate(child, seen, start, stop) for child in children))
        case Or(children):
            return reduce(np.maximum, (_evaluate(child, seen, start, stop) for child in children))
        case Implies(left, right):
            return np.maximum(-_evaluate(left, seen, start, stop)[::-1], _evaluate(right, seen, start, stop))
        case Always(a, b, child):
            return _sliding(np.minimum, _evaluate(child, seen, start + a, stop + b), b - a + 1)
        case Eventually(a, b, child):
            return _sliding(np.maximum, _evaluate(child, seen, start + a, stop + b), b - a + 1)
        case Until(a, b, left, right):
            goal = _evaluate(right, seen, start + a, stop + b)
            if b == 0:
                return goal
            kept = _evaluate(left, seen, start, stop - 1 + b)
            reached = _until(kept[..., a:], goal, b - a + 1)
            if a == 0:
                return reached
            return np.minimum(_sliding(np.minimum, kept, a)[..., : stop - start], reached)
    raise TypeError(f"not a formula: {formula!r}")


def _sliding(extremum: np.ufunc, values: Floats, width: int) -> Floats:
    """The extremum of every `width` neighbours, [..., n + width - 1] to [..., n], in log2(width) passes."""
    n = values.shape[-1] - width + 1
    if n == 1:
        single: Floats = extremum.reduce(values, axis=-1, keepdims=True)
        return single
    size = 1
    while 2 * size <= width:
        values = extremum(values[..., :-size], values[..., size:])
        size *= 2
    doubled: Floats = extremum(values[..., :n], values[..., width - size : width - size + n])
    return doubled


def _until(left: Floats, right: Floats, width: int) -> Floats:
    """max over k < width of min(right[t + k], min left[t : t + k]), for each t < n.

    left [..., n + width - 2], right [..., n + width - 1]. In log2(width) passes, as `_sliding`: `right` is
    reached within m + k steps if it is reached within m, or if `left` holds for m steps and `right` is
    reached within k from there.
    """
    n = right.shape[-1] - width + 1
    reached, kept, size = right, left, 1
    while 2 * size <= width:
        m = reached.shape[-1] - size
        reached = np.maximum(reached[..., :m], np.minimum(kept[..., :m], reached[..., size:]))
        kept = np.minimum(kept[..., :-size], kept[..., size:])
        size *= 2
    rest = width - size
    if rest == 0:
        return reached
    later = np.minimum(_sliding(np.minimum, left, rest)[..., :n], reached[..., rest : rest + n])
    return np.maximum(reached[..., :n], later)


def _predicate(predicate: Atom | Comparison, seen: _Seen, start: int, stop: int) -> Floats:
    """[1, *batch, stop - start] if all of these samples are known, [2, ...] if some are not."""
    known = max(0, min(stop, seen.known) - start)
    term = difference(predicate)
    values = value(term, seen.values, start, start + known)
    exact = np.broadcast_to(values, (1, *seen.batch, known))
    if start + known == stop:
        return exact
    ends = np.empty((2, *seen.batch, stop - start))
    ends[..., :known] = exact
    lo, hi = interval(term)
    ends[0, ..., known:] = lo
    ends[1, ..., known:] = hi
    return ends


def difference(predicate: Atom | Comparison) -> Term:
    """The term whose value is the predicate's robustness."""
    match predicate:
        case Atom(name):
            return Name(name)
        case Comparison(">" | ">=", left, right):
            return Arithmetic("-", left, right)
        case Comparison(_, left, right):
            return Arithmetic("-", right, left)
