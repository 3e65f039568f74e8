"""The Q-network at serving time: three layers as arrays, evaluated one observation at a time.

One observation at a time, so that its answer never depends on a batch's shape; without torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import inlined, leaf
from specshield.errors import PolicyError

NAMES = ("w1", "b1", "w2", "b2", "w3", "b3")
MAX_UNITS = 1024


class Network(NamedTuple):
    """Observation -> w1 -> relu -> w2 -> relu -> w3 -> one Q-value a motion. Weights [inputs, outputs]."""

    w1: NDArray[np.float32]
    b1: NDArray[np.float32]
    w2: NDArray[np.float32]
    b2: NDArray[np.float32]
    w3: NDArray[np.float32]
    b3: NDArray[np.float32]


def make_network(weights: Mapping[str, NDArray[np.generic]], inputs: int, outputs: int) -> Network:
    """Checks weights that come from outside. Raises PolicyError naming the tensor at fault."""
    if sorted(weights) != sorted(NAMES):
        raise PolicyError(
            "not the tensors of a Q-network", path="weights", got=sorted(weights), expected=str(sorted(NAMES))
        )
    for name, array in weights.items():
        if (
            array.dtype != np.float32
            or array.ndim != (2 if name[0] == "w" else 1)
            or not np.isfinite(array).all()
        ):
            raise PolicyError(
                "a tensor is not finite float32 of the right rank", path=f"weights.{name}",
                got=f"{array.dtype} {list(array.shape)}",
                expected="float32, w [inputs, outputs], b [outputs]",
            )  # fmt: skip
    sizes = [inputs, weights["w1"].shape[1], weights["w2"].shape[1], outputs]
    for i in range(3):
        for name, shape in ((f"w{i + 1}", (sizes[i], sizes[i + 1])), (f"b{i + 1}", (sizes[i + 1],))):
            if weights[name].shape != shape or max(shape[-1:]) > MAX_UNITS:
                raise PolicyError(
                    "a tensor does not fit the task", path=f"weights.{name}", got=list(weights[name].shape),
                    expected=f"{list(shape)}, at most {MAX_UNITS} units",
                )  # fmt: skip
    return Network(*(np.ascontiguousarray(weights[name]) for name in NAMES))


@inlined
def _layer(
    x: NDArray[np.float32], w: NDArray[np.float32], b: NDArray[np.float32], out: NDArray[np.float32]
) -> None:
    """out = b + x w, each sum in the inputs' order; eight inputs a pass, so that sums stay in registers."""
    for j in range(out.shape[0]):
        out[j] = b[j]
    whole = x.shape[0] - x.shape[0] % 8
    for i in range(0, whole, 8):
        x0, x1, x2, x3, x4, x5, x6, x7 = (
            x[i],
            x[i + 1],
            x[i + 2],
            x[i + 3],
            x[i + 4],
            x[i + 5],
            x[i + 6],
            x[i + 7],
        )
        for j in range(out.shape[0]):
            total = out[j] + x0 * w[i, j] + x1 * w[i + 1, j] + x2 * w[i + 2, j] + x3 * w[i + 3, j]
            out[j] = total + x4 * w[i + 4, j] + x5 * w[i + 5, j] + x6 * w[i + 6, j] + x7 * w[i + 7, j]
    for i in range(whole, x.shape[0]):
        for j in range(out.shape[0]):
            out[j] += x[i] * w[i, j]


@leaf
def greedy(
    net: Network,
    observation: NDArray[np.float32],
    h1: NDArray[np.float32],
    h2: NDArray[np.float32],
    q: NDArray[np.float32],
) -> int:
    """argmax_a Q(observation, a), the lowest index on ties. h1, h2: scratch; q (M,): the values, written."""
    _layer(observation, net.w1, net.b1, h1)
    for j in range(h1.shape[0]):
        h1[j] = max(h1[j], np.float32(0.0))
    _layer(h1, net.w2, net.b2, h2)
    for j in range(h2.shape[0]):
        h2[j] = max(h2[j], np.float32(0.0))
    _layer(h2, net.w3, net.b3, q)
    best = 0
    for j in range(1, q.shape[0]):
        if q[j] > q[best]:
            best = j
    return best
