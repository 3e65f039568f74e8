"""The kinds of arrays that pass between modules, named after what they hold; docstrings give their shapes."""

from typing import Any, TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from specshield.compiled import inlined

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Int8s = NDArray[np.int8]
Bytes = NDArray[np.uint8]
Singles = NDArray[np.float32]
Int32s = NDArray[np.int32]
Codes = NDArray[np.uint16]
Kind = TypeVar("Kind", bound=np.generic)


def pooled(array: NDArray[Kind], join: np.ufunc, reach: int, axis: int, mode: Any = "edge") -> NDArray[Kind]:
    """`join` (a ufunc such as minimum) of the values at most `reach` places away along an axis. mode: of
    numpy.pad, for what lies beyond its ends. scipy.ndimage has such filters, but takes 0.2 s to import.
    """
    sides = [(reach, reach) if a == axis else (0, 0) for a in range(array.ndim)]
    windows = sliding_window_view(np.pad(array, sides, mode), 2 * reach + 1, axis)
    result = windows[..., 0].copy()
    for n in range(1, 2 * reach + 1):
        join(result, windows[..., n], out=result)
    return result


@inlined
def copy_row(row: NDArray[Kind], to: NDArray[Kind]) -> None:
    """to[: len(row)] = row, of which numba would also compile a message about other lengths, for 1.6 s."""
    for i in range(row.shape[0]):
        to[i] = row[i]
