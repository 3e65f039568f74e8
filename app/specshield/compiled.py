"""How kernels are compiled: cached on disk, without the interpreter's lock, never fastmath."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

njit: Any = numba.njit  # its types leave out the option below
F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """A compiled function that may allocate."""
    compiled: F = njit(cache=True, nogil=True)(function)
    return compiled


def leaf(function: F) -> F:
    """A compiled function that allocates nothing: called in inner loops, with structs of arrays.

    numba counts a reference for each array of a struct at each call, with atomic operations: most of
    a rollout's time. What allocates nothing needs no counting. The option is not in numba's manual; where it
    is gone, the kernels are slower and the same.
    """
    return _leaf(function)


def inlined(function: F) -> F:
    """A leaf that becomes part of its callers: a call copies a struct's hundred words, in an inner loop most
    of its time.
    """
    return _leaf(function, forceinline=True)


def merged(function: F) -> F:
    """A kernel that is written into the one that calls it: each that is compiled by itself, with all that it
    calls, costs seconds.
    """
    compiled: F = njit(inline="always")(function)
    return compiled


def _leaf(function: F, **options: bool) -> F:
    try:
        compiled: F = njit(cache=True, nogil=True, error_model="numpy", _nrt=False, **options)(function)
    except (KeyError, TypeError):
        compiled = njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    return compiled
