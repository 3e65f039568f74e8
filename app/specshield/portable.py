"""Arithmetic that comes out the same to the last bit on x86-64 processors with FMA (made since 2013) and the
same C library, with and without AVX-512.

What was decided on one machine is decided again on another, to the same bytes (`specshield verify`). numpy
computes `exp`, `log`, `tan`, `tanh`, `arctan2` and powers in another way where the processor has AVX-512, and
`@`, `dot` and `linalg` sum in an order that OpenBLAS chooses by the processor. Whatever a decision depends on
takes these functions instead.
"""

from __future__ import annotations

import numpy as np

from specshield.arrays import Floats
from specshield.compiled import kernel


@kernel
def exp(values: Floats) -> Floats:
    """e to each of the values, any shape."""
    return np.exp(values)


@kernel
def log(values: Floats) -> Floats:
    """The natural logarithm of each of the values, any shape."""
    return np.log(values)


@kernel
def arctan2(y: Floats, x: Floats) -> Floats:
    """The direction of each (x, y), any shape [rad]."""
    return np.arctan2(y, x)


def inner(first: Floats, second: Floats) -> Floats:
    """The sums of products over the last axis of both, which are broadcast: shape [...]."""
    total: Floats = np.multiply(first, second).sum(axis=-1)
    return total


@kernel
def solve(matrix: Floats, right: Floats) -> Floats:
    """z (n,) with matrix z = right, for a symmetric positive definite matrix (n, n)."""
    left, found, n = matrix.copy(), right.copy(), len(right)
    for i in range(n):  # Gaussian elimination, which needs no pivots here
        for row in range(i + 1, n):
            factor = left[row, i] / left[i, i]
            left[row] -= factor * left[i]
            found[row] -= factor * found[i]
    for i in range(n - 1, -1, -1):
        for column in range(i + 1, n):
            found[i] -= left[i, column] * found[column]
        found[i] /= left[i, i]
    return found
