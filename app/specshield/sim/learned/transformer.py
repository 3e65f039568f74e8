"""The learned model's network in torch, to train it; network.py is the same for what is done with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from specshield.sim.learned.network import (
    ACTIONS,
    FEATURES,
    KINDS,
    LAYERS,
    NOTHING,
    SLOPES,
    UNITS,
    WINDOW,
    Array,
)


class Transformer(nn.Module):
    """All steps of an episode at once, or one with what is cached."""

    def __init__(self) -> None:
        super().__init__()
        self.sense1, self.sense2 = nn.Linear(FEATURES, 2 * UNITS), nn.Linear(2 * UNITS, UNITS)
        self.last, self.kind = nn.Embedding(NOTHING + 1, UNITS), nn.Embedding(len(KINDS), UNITS)
        self.blocks = nn.ModuleList(Block() for _ in range(LAYERS))
        self.norm, self.head = nn.LayerNorm(UNITS), nn.Linear(UNITS, ACTIONS)
        for embedding in (self.last, self.kind):
            nn.init.normal_(embedding.weight, std=0.3)

    def embed(self, x: torch.Tensor, last: torch.Tensor, kind: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = self.sense2(torch.relu(self.sense1(x))) + self.last(last) + self.kind(kind)
        return out

    def forward(self, x: torch.Tensor, last: torch.Tensor, kind: torch.Tensor) -> torch.Tensor:
        """x [B, T, FEATURES], last [B, T], kind [B]; logits [B, T, A]."""
        h = self.embed(x, last, kind[:, None])
        bias = biases(x.shape[1])
        for block in self.blocks:
            h = block(h, bias)
        out: torch.Tensor = self.head(self.norm(h))
        return out

    def begin(self, robots: int, steps: int) -> None:
        """Empties the cache."""
        shape = (robots, len(SLOPES), steps, UNITS // len(SLOPES))
        self.cache = [(torch.zeros(shape), torch.zeros(shape)) for _ in self.blocks]
        self.bias = biases(steps)

    def keep(self, these: torch.Tensor) -> None:
        """Goes on with some of the robots: bool [B]."""
        self.cache = [(keys[these], values[these]) for keys, values in self.cache]

    @torch.no_grad()
    def distribution(
        self, t: int, x: Array, last: NDArray[np.int64], kind: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Probabilities [B, A] of step t; x [B, FEATURES]."""
        out: NDArray[np.float32] = self.step(t, *map(torch.from_numpy, (x, last, kind))).softmax(-1).numpy()
        return out

    def step(self, t: int, x: torch.Tensor, last: torch.Tensor, kind: torch.Tensor) -> torch.Tensor:
        """Logits [B, A] of step t; x [B, FEATURES]."""
        h = self.embed(x, last, kind)
        for block, (keys, values) in zip(self.blocks, self.cache, strict=True):
            h = cast(Block, block).step(t, h, keys, values, self.bias[:, t, : t + 1])
        out: torch.Tensor = self.head(self.norm(h))
        return out


class Block(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(UNITS), nn.LayerNorm(UNITS)
        self.qkv, self.out = nn.Linear(UNITS, 3 * UNITS), nn.Linear(UNITS, UNITS)
        self.up, self.down = nn.Linear(UNITS, 4 * UNITS), nn.Linear(4 * UNITS, UNITS)

    def forward(self, h: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
        b, t, d = h.shape
        q, k, v = self.qkv(self.norm1(h)).view(b, t, 3, len(SLOPES), -1).permute(2, 0, 3, 1, 4)
        a = functional.scaled_dot_product_attention(q, k, v, attn_mask=bias)
        h = h + self.out(a.transpose(1, 2).reshape(b, t, d))
        return h + self._mlp(h)

    def step(
        self, t: int, h: torch.Tensor, keys: torch.Tensor, values: torch.Tensor, bias: torch.Tensor
    ) -> torch.Tensor:
        b, d = h.shape
        q, k, v = self.qkv(self.norm1(h)).view(b, 3, len(SLOPES), -1).unbind(1)
        keys[:, :, t], values[:, :, t] = k, v
        weights = (keys[:, :, : t + 1] @ q[..., None])[..., 0] / q.shape[-1] ** 0.5 + bias
        a = weights.softmax(-1)[:, :, None] @ values[:, :, : t + 1]
        h = h + self.out(a.reshape(b, d))
        return h + self._mlp(h)

    def _mlp(self, h: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = self.down(torch.relu(self.up(self.norm2(h))))
        return out


def biases(steps: int) -> torch.Tensor:
    """What is added to the attention of step i to step j, [heads, T, T]: less the longer ago, none ahead."""
    ago = torch.arange(steps)[:, None] - torch.arange(steps)[None, :]
    bias = -torch.tensor(SLOPES)[:, None, None] * ago
    return bias.masked_fill((ago < 0) | (ago >= WINDOW), float("-inf"))


EMBEDDINGS = ("last", "kind")


def export(network: Transformer) -> dict[str, Array]:
    """The weights as network.py takes them: w [inputs, outputs]."""
    tensors = {}
    for name, tensor in network.state_dict().items():
        array = tensor.detach().numpy()
        tensors[_serving(name)] = np.ascontiguousarray(array.T if _turned(name, array) else array).copy()
    return tensors


def restore(weights: Mapping[str, Array]) -> Transformer:
    """A network with checked weights: the inverse of `export`."""
    network = Transformer()
    with torch.no_grad():
        for name, tensor in network.state_dict().items():
            array = weights[_serving(name)]
            tensor.copy_(torch.from_numpy(np.ascontiguousarray(array.T if _turned(name, array) else array)))
    return network


def _serving(name: str) -> str:
    if name.removesuffix(".weight") in EMBEDDINGS:
        return name.removesuffix(".weight")
    return name.removeprefix("blocks.").replace(".weight", ".w").replace(".bias", ".b")


def _turned(name: str, array: Array) -> bool:
    return array.ndim == 2 and name.removesuffix(".weight") not in EMBEDDINGS
