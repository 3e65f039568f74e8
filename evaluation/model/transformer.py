"""The learned model's network in torch, to train it; sim/learned/network.py is the same in NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from specshield.arrays import Singles
from specshield.sim.learned.network import (
    ACTIONS,
    FAR,
    FEATURES,
    KINDS,
    LAYERS,
    NOTHING,
    SLOPES,
    SPAN,
    UNITS,
    WINDOW,
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

    def forward(
        self, x: torch.Tensor, place: torch.Tensor, last: torch.Tensor, kind: torch.Tensor
    ) -> torch.Tensor:
        """x [B, T, FEATURES], place [B, T, 3], last [B, T], kind [B]; logits [B, T, A]."""
        h = self.embed(x, last, kind[:, None])
        far = torch.cdist(place[..., :2], place[..., :2])
        bias = biases(x.shape[1]) - torch.tensor(FAR)[:, None, None] * far[:, None]
        for block in self.blocks:
            h = block(h, place, bias)
        out: torch.Tensor = self.head(self.norm(h))
        return out

    def begin(self, robots: int, steps: int) -> None:
        """Empties the cache."""
        shape = (robots, len(SLOPES), steps, UNITS // len(SLOPES))
        self.cache = [(torch.zeros(shape), torch.zeros(shape)) for _ in self.blocks]
        self.places = torch.zeros(robots, steps, 2)
        self.bias = biases(steps)

    def keep(self, these: torch.Tensor) -> None:
        """Goes on with some of the robots: bool [B]."""
        self.cache = [(keys[these], values[these]) for keys, values in self.cache]
        self.places = self.places[these]

    @torch.no_grad()
    def logits(
        self, t: int, x: Singles, place: Singles, last: NDArray[np.int64], kind: NDArray[np.int64]
    ) -> Singles:
        """Logits [B, A] of step t; x [B, FEATURES], place [B, 3]."""
        out: Singles = self.step(t, *map(torch.from_numpy, (x, place, last, kind))).numpy()
        return out

    def step(
        self, t: int, x: torch.Tensor, place: torch.Tensor, last: torch.Tensor, kind: torch.Tensor
    ) -> torch.Tensor:
        """Logits [B, A] of step t; x [B, FEATURES], place [B, 3]."""
        h = self.embed(x, last, kind)
        self.places[:, t] = place[:, :2]
        ways = egocentric(self.places[:, : t + 1] - place[:, None, :2], place[:, None, 2])
        far = torch.hypot(ways[..., 0], ways[..., 1])
        bias = self.bias[:, t, : t + 1] - torch.tensor(FAR)[:, None] * far[:, None]
        for block, (keys, values) in zip(self.blocks, self.cache, strict=True):
            h = cast(Block, block).step(t, h, keys, values, ways / SPAN, bias)
        out: torch.Tensor = self.head(self.norm(h))
        return out


class Block(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(UNITS), nn.LayerNorm(UNITS)
        self.qkv, self.out = nn.Linear(UNITS, 3 * UNITS), nn.Linear(UNITS + 2 * len(SLOPES), UNITS)
        self.up, self.down = nn.Linear(UNITS, 4 * UNITS), nn.Linear(4 * UNITS, UNITS)

    def forward(self, h: torch.Tensor, place: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
        b, t, d = h.shape
        q, k, v = self.qkv(self.norm1(h)).view(b, t, 3, len(SLOPES), -1).permute(2, 0, 3, 1, 4)
        weights = ((q @ k.transpose(-1, -2)) * q.shape[-1] ** -0.5 + bias).softmax(-1)
        a = (weights.to(v.dtype) @ v).transpose(1, 2).reshape(b, t, d)
        there = (weights @ place[:, None, :, :2]).transpose(1, 2)  # [B, T, heads, 2]
        ways = egocentric(there - place[:, :, None, :2], place[:, :, None, 2]) / SPAN
        h = h + self.out(torch.cat([a, ways.reshape(b, t, -1).to(a.dtype)], -1))
        return h + self._mlp(h)

    def step(
        self,
        t: int,
        h: torch.Tensor,
        keys: torch.Tensor,
        values: torch.Tensor,
        ways: torch.Tensor,
        bias: torch.Tensor,
    ) -> torch.Tensor:
        b, d = h.shape
        q, k, v = self.qkv(self.norm1(h)).view(b, 3, len(SLOPES), -1).unbind(1)
        keys[:, :, t], values[:, :, t] = k, v
        weights = (keys[:, :, : t + 1] @ q[..., None])[..., 0] / q.shape[-1] ** 0.5 + bias
        weights = weights.softmax(-1)[:, :, None]
        a = weights @ values[:, :, : t + 1]
        there = weights @ ways[:, None]
        h = h + self.out(torch.cat([a.reshape(b, d), there.reshape(b, -1)], -1))
        return h + self._mlp(h)

    def _mlp(self, h: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = self.down(torch.relu(self.up(self.norm2(h))))
        return out


def egocentric(ways: torch.Tensor, heading: torch.Tensor) -> torch.Tensor:
    """Ways [..., 2] as from the robot: ahead, to the left."""
    cos, sin = torch.cos(heading), torch.sin(heading)
    return torch.stack([cos * ways[..., 0] + sin * ways[..., 1], cos * ways[..., 1] - sin * ways[..., 0]], -1)


def biases(steps: int) -> torch.Tensor:
    """What is added to the attention of step i to step j, [heads, T, T]: less the longer ago, none ahead."""
    ago = torch.arange(steps)[:, None] - torch.arange(steps)[None, :]
    bias = -torch.tensor(SLOPES)[:, None, None] * ago
    return bias.masked_fill((ago < 0) | (ago >= WINDOW), float("-inf"))


EMBEDDINGS = ("last", "kind")


def export(network: Transformer) -> dict[str, Singles]:
    """The weights as network.py takes them: w [inputs, outputs]."""
    tensors = {}
    for name, tensor in network.state_dict().items():
        array = tensor.detach().numpy()
        tensors[_serving(name)] = np.ascontiguousarray(array.T if _turned(name, array) else array).copy()
    return tensors


def restore(weights: Mapping[str, Singles]) -> Transformer:
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


def _turned(name: str, array: Singles) -> bool:
    return array.ndim == 2 and name.removesuffix(".weight") not in EMBEDDINGS
