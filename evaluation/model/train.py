"""Training of the learned foundation model: imitation of shortest paths, in rounds.

In each round the robots practise in random apartments, and the network learns what the expert did in this
round and in recent ones. In a share of the episodes the network drives first and then the expert takes over:
so the network learns to go on from where its own mistakes lead. Other than in DAgger (Ross et al., 2011), it
does not learn what the expert would have done while it drove itself. The expert knows the map, and often only
its last actions show where it is going: a network that does not find them in its past learns to waver.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import softmax
from torch import nn
from torch.nn import functional

from evaluation.model.expert import END
from evaluation.model.floor_plans import House, random_house
from evaluation.model.practice import Practice, make_apartments, sample
from evaluation.model.transformer import Transformer
from specshield.sim.learned.network import ACTIONS, FEATURES, KINDS, TEMPERATURE, decoded, features
from specshield.sim.learned.reckoning import Reckoning
from specshield.sim.senses import RAYS

CHANCES = (0.25, 0.25, *([0.125] * (len(KINDS) - 2)))  # of each kind: two of them are kept in kitchens

ALONE = (10, 250)  # steps that the network drives before the expert takes over
LATEST = 80  # half of the time it drives from the first step on, otherwise from a step before this one
WRONG_END = 3.0  # weight of an `end` at the wrong place, beside the imitation


@dataclass(frozen=True)
class Settings:
    houses: int = 400
    rounds: int = 400
    robots: int = 64  # episodes a round
    steps: int = 320  # of an episode, at most
    passes: int = 2  # over as many episodes as a round has, drawn from the recent ones
    recent: int = 20  # rounds
    batch: int = 8  # episodes
    learning_rate: float = 1e-3
    given: float = 0.25  # share of the episodes in given apartments, where there are any
    own: float = 0.5  # share of the episodes that the network drives first, from a third of the rounds on
    interference: bool = True  # whether robots are held, steered and slip in half of the episodes

    def to_json(self) -> dict[str, float]:
        return asdict(self)


@dataclass
class Episodes:
    """Of one round: x [N, T, FEATURES], place [N, T, 3], last [N, T], kind [N], advice [N, T, A], length [N].

    counts [N, T]: what is learned from, the steps that the expert drove.
    """

    x: NDArray[np.float32]
    place: NDArray[np.float32]
    last: NDArray[np.int64]
    kind: NDArray[np.int64]
    advice: NDArray[np.float32]
    counts: NDArray[np.bool_]
    length: NDArray[np.int64]


def practise(
    network: Transformer, practice: Practice, steps: int, own: float, random: np.random.Generator
) -> Episodes:
    """One round: the expert drives, and with chance `own` the network does for a while before."""
    practice.reset(CHANCES)
    n = len(practice.pose)
    begin = np.where(random.random(n) < 0.5, 0, random.integers(0, LATEST, n))
    until = np.where(random.random(n) < own, begin + random.integers(*ALONE, n), 0)
    out = Episodes(
        np.zeros((n, steps, FEATURES), np.float32), np.zeros((n, steps, 3), np.float32),
        np.zeros((n, steps), np.int64), practice.kind.copy(), np.zeros((n, steps, ACTIONS), np.float32),
        np.zeros((n, steps), np.bool_), np.full(n, steps),
    )  # fmt: skip
    busy = np.nonzero(until)[0]  # whom the network will have driven, and who is not done
    network.begin(len(busy), steps)
    reckoning = Reckoning(n)
    for t in range(steps):
        reckoning.count(practice.senses[:, :RAYS], practice.last)
        out.place[:, t], out.last[:, t] = reckoning.place, practice.last
        out.x[:, t] = features(practice.senses, reckoning.place[:, 2])
        out.advice[:, t] = practice.advice
        wish = practice.advice.copy()
        if t % 8 == 0 and len(busy):
            these = ~practice.done[busy] & (until[busy] > t)
            network.keep(torch.from_numpy(these))
            busy = busy[these]
        driven = (t >= begin) & (t < until)
        out.counts[:, t] = ~driven & ~practice.interfered
        if len(busy):
            last = practice.last[busy]
            raw = network.logits(t, out.x[busy, t], out.place[busy, t], last, practice.kind[busy])
            its = softmax(decoded(raw, last, reckoning.futile[busy], TEMPERATURE), axis=1)
            wish[busy] = np.where(driven[busy, None], its, wish[busy])
        before = practice.done.copy()
        practice.execute(sample(wish, random))
        out.length[practice.done & ~before] = t + 1
        if practice.done.all():
            break
    return out


def train(
    settings: Settings,
    seed: int,
    given: list[House],
    on_round: Callable[[Report], None],
    start: Transformer | None = None,
) -> Transformer:
    """given: apartments to practise in besides the `settings.houses` random ones. start: goes on from it."""
    torch.set_num_threads(1)  # more of them wait for each other, one practises meanwhile
    random = np.random.default_rng(seed)
    torch.manual_seed(seed)
    houses = given + [random_house(random) for _ in range(settings.houses)]
    weight = np.full(len(houses), (1.0 - settings.given if given else 1.0) / settings.houses)
    weight[: len(given)] = settings.given / max(len(given), 1)
    practice = Practice(
        make_apartments(houses), settings.robots, random.spawn(1)[0], weight, settings.interference
    )
    network, actor = start or Transformer(), Transformer()
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
    x, place, last, advice = (
        torch.from_numpy(np.stack([getattr(e, name)[i, :longest] for e, i in batch]))
        for name in ("x", "place", "last", "advice")
    )
    kind = torch.tensor([int(e.kind[i]) for e, i in batch])
    length = torch.tensor([int(e.length[i]) for e, i in batch])
    valid = torch.arange(longest)[None] < length[:, None]
    valid &= torch.from_numpy(np.stack([e.counts[i, :longest] for e, i in batch]))
    if not valid.any():
        return 0.0
    logits = network(x, place, last, kind)
    logp = functional.log_softmax(logits[valid], -1)
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
