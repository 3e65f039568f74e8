"""The Q-network as the service evaluates it: three layers as arrays, without torch.

It takes one observation at a time, because a batch's answer could depend on the batch's shape.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.arrays import Singles, copy_row
from specshield.compiled import inlined, kernel, leaf
from specshield.errors import PolicyError

NAMES = ("w1", "b1", "w2", "b2", "w3", "b3")
MAX_UNITS = 1024  # of a layer; bounds the time of a decision with weights that come from outside


class Network(NamedTuple):
    """Observation -> w1 -> relu -> w2 -> relu -> w3 -> one Q-value a motion. Weights [inputs, outputs]."""

    w1: Singles
    b1: Singles
    w2: Singles
    b2: Singles
    w3: Singles
    b3: Singles


class Layers(NamedTuple):
    """What the network computed last: both hidden layers, and q [M], the value of each motion."""

    h1: Singles
    h2: Singles
    q: Singles


def make_network(weights: Mapping[str, NDArray[np.generic]], inputs: int, outputs: int) -> Network:
    """Checks weights that come from outside. Raises PolicyError naming the tensor at fault."""
    if sorted(weights) != sorted(NAMES):
        told, expected = "these are not the tensors of a Q-network", str(sorted(NAMES))
        raise PolicyError(told, path="weights", got=sorted(weights), expected=expected)
    before = inputs
    for layer in (1, 2, 3):
        after = outputs if layer == 3 else np.atleast_1d(weights[f"w{layer}"]).shape[-1]
        for name, shape in ((f"w{layer}", (before, after)), (f"b{layer}", (after,))):
            array = weights[name]
            usable = array.dtype == np.float32 and bool(np.isfinite(array).all())
            if not usable or array.shape != shape or after > MAX_UNITS:
                raise PolicyError(
                    "a tensor does not fit the task",
                    path=f"weights.{name}",
                    got=f"{array.dtype} {list(array.shape)}",
                    expected=f"finite float32 {list(shape)}, at most {MAX_UNITS} units",
                )
        before = after
    return Network(*(np.ascontiguousarray(weights[name]) for name in NAMES))


@kernel
def make_layers(net: Network) -> Layers:
    h1, h2 = np.empty(net.b1.shape[0], np.float32), np.empty(net.b2.shape[0], np.float32)
    return Layers(h1, h2, np.empty(net.b3.shape[0], np.float32))


@leaf
def greedy(net: Network, observation: Singles, layers: Layers) -> int:
    """argmax_a Q(observation, a), the lowest index on ties. Overwrites `layers`."""
    _layer(observation, net.w1, net.b1, layers.h1)
    _relu(layers.h1)
    _layer(layers.h1, net.w2, net.b2, layers.h2)
    _relu(layers.h2)
    _layer(layers.h2, net.w3, net.b3, layers.q)
    best = 0
    for j in range(1, layers.q.shape[0]):
        if layers.q[j] > layers.q[best]:
            best = j
    return best


@inlined
def _layer(x: Singles, w: Singles, b: Singles, out: Singles) -> None:
    """out = b + x w, each sum in the inputs' order; eight inputs a pass, so that sums stay in registers."""
    copy_row(b, out)
    whole = x.shape[0] - x.shape[0] % 8
    for i in range(0, whole, 8):
        x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
        x4, x5, x6, x7 = x[i + 4], x[i + 5], x[i + 6], x[i + 7]
        for j in range(out.shape[0]):
            total = out[j] + x0 * w[i, j] + x1 * w[i + 1, j] + x2 * w[i + 2, j] + x3 * w[i + 3, j]
            out[j] = total + x4 * w[i + 4, j] + x5 * w[i + 5, j] + x6 * w[i + 6, j] + x7 * w[i + 7, j]
    for i in range(whole, x.shape[0]):
        for j in range(out.shape[0]):
            out[j] += x[i] * w[i, j]


@inlined
def _relu(x: Singles) -> None:
    for j in range(x.shape[0]):
        x[j] = max(x[j], np.float32(0.0))
