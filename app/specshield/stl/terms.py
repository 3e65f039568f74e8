"""The value of a term: exact at steps whose samples are known, an interval at steps still to come."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any, TypeAlias

import numpy as np

from specshield.arrays import Floats
from specshield.errors import SampleError
from specshield.stl.formula import Abs, Arithmetic, Name, Neg, Node, Number, Term

Interval: TypeAlias = tuple[Any, Any]  # the lower and the upper bound
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


@np.errstate(all="ignore")
def interval(term: Term, read: Callable[[str], Interval] = lambda name: (-np.inf, np.inf)) -> Interval:
    """Bounds on the term's value by interval arithmetic, as numbers or arrays. `read` gives the bounds on a
    name; by default every name may be any real number.
    """
    match term:
        case Number(number):
            return number, number
        case Name(name):
            return read(name)
        case Neg(child):
            low, high = interval(child, read)
            return -high, -low
        case Abs(child):
            low, high = interval(child, read)
            return np.maximum(np.maximum(low, -high), 0.0), np.maximum(high, -low)
        case Arithmetic(op, left, right):
            (a, b), (c, d) = interval(left, read), interval(right, read)
            if op in "+-":
                low, high = (a + c, b + d) if op == "+" else (a - d, b - c)
                # inf - inf is NaN. It takes a sum that overflows, so nothing is known of that end.
                return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
            # Samples are finite, so 0 * inf is 0. inf / inf lies between 0 and inf, which are ends as well.
            ends = [_ARITHMETIC[op](x, y) for x in (a, b) for y in (c, d)]
            ends = [np.where(np.isnan(end), 0.0, end) for end in ends]
            unknown = (op == "/") & (c <= 0.0) & (d >= 0.0)
            low, high = reduce(np.minimum, ends), reduce(np.maximum, ends)
            return np.where(unknown, -np.inf, low), np.where(unknown, np.inf, high)
    raise TypeError(f"not a term: {term!r}")
