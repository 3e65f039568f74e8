"""The value of a term: exact at steps whose samples are known, an interval at steps still to come."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from specshield.arrays import Floats
from specshield.errors import SampleError
from specshield.stl.formula import Abs, Arithmetic, Name, Neg, Node, Number, Term

_ARITHMETIC = {"+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide}


def value(term: Term, samples: Mapping[str, Floats], start: int, stop: int) -> Any:
    """The term at steps start to stop - 1, whose samples are known: [*batch, stop - start], or a number.

    Raises SampleError where the arithmetic is not finite.
    """
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
                # A term without names has no time axis: it is the same number at every step.
                time = start + (int(np.argwhere(~np.isfinite(result))[0][-1]) if np.ndim(result) else 0)
                raise SampleError(
                    f"'{term}' is not finite at step {time}",
                    expected="samples on which the formula's arithmetic is finite",
                    time=time,
                    expression=str(term),
                )
            return result
    raise TypeError(f"not a term: {term!r}")


def may_fail(node: Node) -> bool:
    """Whether some term in it may have no value at some states: it divides or multiplies names."""
    match node:
        case Arithmetic("+" | "-") | Arithmetic("*", Number()) | Arithmetic("*" | "/", _, Number()):
            return any(map(may_fail, node.parts))
    return isinstance(node, Arithmetic) or any(map(may_fail, node.parts))


def interval(term: Term) -> tuple[float, float]:
    """Bounds on the term's value if every name may be any real number (interval arithmetic)."""
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
                # inf - inf is NaN. It takes a sum that overflows, so nothing is known of that end.
                return -math.inf if math.isnan(lo) else lo, math.inf if math.isnan(hi) else hi
            # Samples are finite, so 0 * inf is 0. inf / inf lies between 0 and inf, which are ends as well.
            ends = [x * y if op == "*" else x / y for x in a for y in b]
            ends = [0.0 if math.isnan(end) else end for end in ends]
            return min(ends), max(ends)
    raise TypeError(f"not a term: {term!r}")
