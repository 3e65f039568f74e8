"""The kinds of arrays that pass between modules, named after what they hold; docstrings give their shapes."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Int8s = NDArray[np.int8]
Bytes = NDArray[np.uint8]
Singles = NDArray[np.float32]
Int32s = NDArray[np.int32]
Codes = NDArray[np.uint16]
