"""The values of terms: exact where the samples are known, an interval where they are still to come."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from specshield.errors import SampleError
from specshield.stl.formula import Abs, Arithmetic, Name, Neg, Number, Term

Array: TypeAlias = NDArray[np.float64]

_ARITHMETIC = {"+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide}


def value(term: Term, samples: Mapping[str, Array], start: int, stop: int) -> Any:
    """The term at known steps, [*batch, stop - start] or a number."""
    match term:
        case Number(number):
            return number
        case Name(name):
            return samples[name][..., start:stop]
        case Neg(child):
            return -value(child, samples, start, stop)
        case Abs(child):
            return np.abs(value(child, samples, start, stop))
        case Arithmetic(op, left, right):
            result = _ARITHMETIC[op](value(left, samples, start, stop), value(right, samples, start, stop))
            if stop > start and not np.isfinite(result).all():
                # A term without names is a number, the same at every step.
                time = start + (int(np.argwhere(~np.isfinite(result))[0][-1]) if np.ndim(result) else 0)
                raise SampleError(
                    f"'{term}' is not finite at step {time}",
                    expected="samples on which the formula's arithmetic is finite",
                    time=time,
                    expression=str(term),
                )
            return result
    raise TypeError(f"not a term: {term!r}")


def interval(term: Term) -> tuple[float, float]:
    """Bounds on the term's value where every name may be any real number."""
    match term:
        case Number(number):
            return number, number
        case Name():
            return -math.inf, math.inf
        case Neg(child):
            lo, hi = interval(child)
            return -hi, -lo
        case Abs(child):
            lo, hi = interval(child)
            return max(0.0, lo, -hi), max(hi, -lo)
        case Arithmetic(op, left, right):
            a, b = interval(left), interval(right)
            if op == "/" and b[0] <= 0.0 <= b[1]:
                return -math.inf, math.inf
            if op in "+-":
                c = b if op == "+" else (-b[1], -b[0])
                lo, hi = a[0] + c[0], a[1] + c[1]
                # NaN is inf - inf, which only a term that overflows anyway can bring about.
                return -math.inf if math.isnan(lo) else lo, math.inf if math.isnan(hi) else hi
            # 0 * inf is 0, for samples are finite; inf / inf stands between 0 and inf, which the others give.
            ends = [x * y if op == "*" else x / y for x in a for y in b]
            ends = [0.0 if math.isnan(end) else end for end in ends]
            return min(ends), max(ends)
    raise TypeError(f"not a term: {term!r}")
