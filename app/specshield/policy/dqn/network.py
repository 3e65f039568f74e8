"""The Q-network as the service evaluates it: three layers as arrays, without torch.

It takes one observation at a time, because a batch's answer could depend on the batch's shape.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from specshield.arrays import Singles
from specshield.compiled import inlined, kernel, leaf
from specshield.errors import PolicyError

build: Any = cgutils  # its functions have no types
NAMES = ("w1", "b1", "w2", "b2", "w3", "b3")
MAX_UNITS = 1024  # of a layer; bounds the time of a decision with weights that come from outside
MANY, FEW = 64, 8  # outputs that are summed at once: what half of the registers hold, and what one holds
LINE = 16  # numbers that a processor reads at once: weights that lie across two lines took a third longer


class Network(NamedTuple):
    """Observation -> w1 -> relu -> w2 -> relu -> w3 -> one Q-value a motion. Weights [inputs, outputs].

    Only `make_network` makes one: kernels read up to FEW numbers beyond the end of each array.
    """

    w1: Singles
    b1: Singles
    w2: Singles
    b2: Singles
    w3: Singles
    b3: Singles


class Layers(NamedTuple):
    """A network and what it computed last: both hidden layers, and q [M], the value of each motion."""

    net: Network
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
    return Network(*(_roomy(weights[name]) for name in NAMES))


def _roomy(array: NDArray[np.generic]) -> Singles:
    """A copy that begins with a line, and after which FEW more numbers can be read."""
    room = np.zeros(array.size + LINE + FEW, np.float32)
    copy = room[-(room.ctypes.data // 4) % LINE :][: array.size].reshape(array.shape)
    copy[...] = array
    return copy


@kernel
def make_layers(net: Network) -> Layers:
    h1, h2, h3 = net.b1.shape[0], net.b2.shape[0], net.b3.shape[0]
    room = np.empty((3, max(h1, h2, h3) + FEW), np.float32)
    return Layers(net, room[0, :h1], room[1, :h2], room[2, :h3])


@leaf
def greedy(layers: Layers, observation: Singles) -> int:
    """argmax_a Q(observation, a), the lowest index on ties. Overwrites what was computed last."""
    net = layers.net
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
    """out = b + x w, each sum in the inputs' order. Writes up to FEW - 1 numbers more than `out` has."""
    whole = b.shape[0] - b.shape[0] % MANY
    for j in range(0, whole, MANY):
        _many_sums(x, w, b, j, out)
    for j in range(whole, b.shape[0], FEW):
        _few_sums(x, w, b, j, out)


def _sums(count: int) -> Any:
    """A function (x, w, b, j, out) for kernels: `_layer` for `count` outputs, from the j-th on.

    LLVM's own code for such loops writes the sums to memory after every few inputs, and takes half as long
    again. These stay in registers. Products are rounded before they are added, as in any other kernel.
    """
    vector, first = ir.VectorType(ir.FloatType(), count), ir.VectorType(ir.IntType(32), count)(None)

    def sums(typing: Any, x: Any, w: Any, b: Any, j: Any, out: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            x, w, b, out = (
                context.make_array(signature.args[i])(context, builder, given[i]) for i in (0, 1, 2, 4)
            )
            inputs, width = (builder.extract_value(w.shape, axis) for axis in (0, 1))

            def at(array: Any, place: Any) -> Any:
                return builder.bitcast(builder.gep(array.data, [place]), vector.as_pointer())

            total = build.alloca_once_value(builder, builder.load(at(b, given[3]), align=4))
            with build.for_range(builder, inputs) as loop:
                value = builder.load(builder.gep(x.data, [loop.index]))
                one = builder.insert_element(vector(ir.Undefined), value, ir.IntType(32)(0))
                row = builder.add(builder.mul(loop.index, width), given[3])
                products = builder.fmul(
                    builder.shuffle_vector(one, one, first), builder.load(at(w, row), align=4)
                )
                builder.store(builder.fadd(builder.load(total), products), total)
            builder.store(builder.load(total), at(out, given[3]), align=4)
            return context.get_dummy_value()

        return types.void(x, w, b, j, out), code

    return intrinsic(sums)


_many_sums, _few_sums = _sums(MANY), _sums(FEW)


@inlined
def _relu(x: Singles) -> None:
    for j in range(x.shape[0]):
        x[j] = max(x[j], np.float32(0.0))
