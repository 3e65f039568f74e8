"""Training of the learned foundation model: imitation of shortest paths, in rounds; alone in importing torch.

Each round the robots practise in random apartments, each driven by the expert or by what has been learned so
far (DAgger: Ross et al., 2011), and the network learns the expert's answers to all that they met, of this
round and of recent ones.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from specshield.sim.learned.expert import END
from specshield.sim.learned.floor_plans import House, random_house
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
    features,
)
from specshield.sim.learned.practice import Practice, make_apartments, sample

CHANCES = (0.25, 0.25, *([0.125] * (len(KINDS) - 2)))  # of each kind: two of them are kept in kitchens


WRONG_END = 3.0  # what an `end` at the wrong place costs, beside the imitation


@dataclass(frozen=True)
class Settings:
    houses: int = 400
    rounds: int = 300
    robots: int = 64  # episodes a round
    steps: int = 256  # of an episode, at most
    passes: int = 2  # over as many episodes as a round has, drawn from the recent ones
    recent: int = 20  # rounds
    batch: int = 16  # episodes
    learning_rate: float = 1e-3
    own: float = 0.7  # share of the episodes that the network drives itself, from a third of the rounds on

    def to_json(self) -> dict[str, float]:
        return asdict(self)


class Transformer(nn.Module):
    """Like network.py, which has the words: all steps of an episode at once, or one with what is cached."""

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


def export(network: Transformer) -> dict[str, Array]:
    """The weights as network.py takes them: w [inputs, outputs]."""
    tensors = {}
    for name, tensor in network.state_dict().items():
        array = tensor.detach().numpy()
        if name in ("last.weight", "kind.weight"):
            tensors[name.removesuffix(".weight")] = array.copy()
        else:
            serving = name.removeprefix("blocks.").replace(".weight", ".w").replace(".bias", ".b")
            tensors[serving] = np.ascontiguousarray(array.T if array.ndim == 2 else array).copy()
    return tensors


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


@dataclass
class Episodes:
    """Of one round: x [N, T, FEATURES] float32, last [N, T], kind [N], advice [N, T, A], length [N]."""

    x: NDArray[np.float32]
    last: NDArray[np.int64]
    kind: NDArray[np.int64]
    advice: NDArray[np.float32]
    length: NDArray[np.int64]


def practise(
    network: Transformer, practice: Practice, steps: int, own: float, random: np.random.Generator
) -> Episodes:
    """One round: each robot is driven by the network with chance `own`, else by the expert."""
    practice.reset(CHANCES)
    n = len(practice.pose)
    driven = random.random(n) < own
    out = Episodes(
        np.zeros((n, steps, FEATURES), np.float32), np.zeros((n, steps), np.int64), practice.kind.copy(),
        np.zeros((n, steps, ACTIONS), np.float32), np.full(n, steps),
    )  # fmt: skip
    busy = np.nonzero(driven)[0]  # whom the network drives, and who is not done
    network.begin(len(busy), steps)
    for t in range(steps):
        out.x[:, t], out.last[:, t] = features(practice.senses), practice.last
        out.advice[:, t] = practice.advice
        wish = practice.advice.copy()
        if t % 16 == 0 and practice.done[busy].any():
            network.keep(torch.from_numpy(~practice.done[busy]))
            busy = busy[~practice.done[busy]]
        if len(busy):
            wish[busy] = network.distribution(t, out.x[busy, t], practice.last[busy], practice.kind[busy])
        before = practice.done.copy()
        practice.execute(sample(wish, random))
        out.length[practice.done & ~before] = t + 1
        if practice.done.all():
            break
    return out


def train(
    settings: Settings, seed: int, houses: list[House], on_round: Callable[[Report], None]
) -> Transformer:
    """houses: apartments to practise in besides `settings.houses` random ones."""
    torch.set_num_threads(1)  # more of them wait for each other, one practises meanwhile
    random = np.random.default_rng(seed)
    torch.manual_seed(seed)
    houses = houses + [random_house(random) for _ in range(settings.houses)]
    practice = Practice(make_apartments(houses), settings.robots, random.spawn(1)[0])
    network, actor = Transformer(), Transformer()
    optimizer = torch.optim.AdamW(network.parameters(), lr=settings.learning_rate, weight_decay=0.01)
    rounds: list[Episodes] = []
    own = random.spawn(1)[0]

    def practised(r: int) -> Episodes:
        share = settings.own * min(1.0, 3.0 * r / settings.rounds)
        return practise(actor, practice, settings.steps, share, own)

    with ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,)) as practising:
        upcoming = practising.submit(practised, 0)
        for r in range(settings.rounds):
            began = time.monotonic()
            rounds = [*rounds, upcoming.result()][-settings.recent :]
            waited = time.monotonic() - began
            actor.load_state_dict(network.state_dict())
            upcoming = practising.submit(practised, r + 1)
            rate = (
                settings.learning_rate
                * min(1.0, (r + 1) / 20)
                * (0.5 + 0.5 * math.cos(math.pi * r / settings.rounds))
            )
            for group in optimizer.param_groups:
                group["lr"] = max(rate, 1e-5)
            losses = [
                _learn(network, optimizer, batch)
                for p in range(settings.passes)
                for batch in _batches(rounds, settings, fresh=p == 0, random=random)
            ]
            on_round(
                Report(
                    r,
                    network,
                    float(np.mean(losses)),
                    float(rounds[-1].length.mean()),
                    waited,
                    time.monotonic() - began,
                )
            )
        upcoming.result()
    return network


@dataclass
class Report:
    round: int
    network: Transformer
    loss: float
    length: float
    waited_s: float
    took_s: float


Batch = list[tuple[Episodes, int]]


def _batches(
    rounds: list[Episodes], settings: Settings, fresh: bool, random: np.random.Generator
) -> list[Batch]:
    """As many episodes as a round has, of the newest or of any recent round; each batch of like lengths."""
    n = settings.robots
    which = np.full(n, len(rounds) - 1) if fresh else random.integers(0, len(rounds), n)
    who = np.arange(n) if fresh else random.integers(0, n, n)
    pairs = sorted(
        ((rounds[k], int(i)) for k, i in zip(which, who, strict=True)), key=lambda p: p[0].length[p[1]]
    )
    batches = [pairs[i : i + settings.batch] for i in range(0, n, settings.batch)]
    return [batches[i] for i in random.permutation(len(batches))]


def _learn(network: Transformer, optimizer: torch.optim.Optimizer, batch: Batch) -> float:
    """One update on some episodes; the loss, in nats a step."""
    longest = max(int(e.length[i]) for e, i in batch)
    x, last, advice = (
        torch.from_numpy(np.stack([getattr(e, name)[i, :longest] for e, i in batch]))
        for name in ("x", "last", "advice")
    )
    kind = torch.tensor([int(e.kind[i]) for e, i in batch])
    length = torch.tensor([int(e.length[i]) for e, i in batch])
    valid = torch.arange(longest)[None] < length[:, None]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        logits = network(x, last, kind)
    logp = functional.log_softmax(logits.float()[valid], -1)
    advice = advice[valid]
    loss = -(advice * logp).sum(-1).mean()
    # An `end` at the wrong place cannot be taken back: it costs more than another wrong action.
    end = logp[:, END].exp().clamp(max=1.0 - 1e-6)
    wrong = torch.where(advice[:, END] == 0.0, -torch.log1p(-end), 0.0).mean()
    optimizer.zero_grad(set_to_none=True)
    (loss + WRONG_END * wrong).backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_(network.parameters(), 1.0)
    optimizer.step()
    return float(loss.detach())
