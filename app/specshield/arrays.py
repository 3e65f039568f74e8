"""The kinds of arrays that pass between modules, named after what they hold; docstrings give their shapes."""

import numpy as np
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


@inlined
def copy_row(row: Floats, to: Floats) -> None:
    """to[:] = row, for rows of one length. For that, numba compiles a message about other lengths: 1.6 s."""
    for i in range(row.shape[0]):
        to[i] = row[i]
