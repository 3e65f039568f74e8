"""Deep Q-learning as one of the methods: its options, and where its parts are."""

from __future__ import annotations

from dataclasses import dataclass

from specshield.policy.methods import Method, lazily
from specshield.policy.options import option


@dataclass(frozen=True)
class Settings:
    """What a caller may choose."""

    reward: str = option(
        "progress",
        "The funnels' reward: as the paper has it, or for progress towards what is next.",
        choices=("progress", "paper"),
    )
    units: int = option(64, "Width of the network's two hidden layers.", low=4, high=128)
    updates: int = option(16_000, "Steps of learning.", low=1, high=1_000_000)
    robots: int = option(512, "Robots that are simulated side by side.", low=1, high=4096)
    batch: int = option(1024, "Transitions an update learns from.", low=1, high=65536)
    learning_rate: float = option(1e-3, "Adam's, falling to 2 % of it.", low=1e-7, high=1.0)
    discount: float = option(0.98, "Of the reward, for each step.", low=0.0, high=1.0)
    returns: int = option(5, "Steps of an n-step return.", low=1, high=64)
    polyak: float = option(
        0.02, "How far the target network moves to the network, an update.", low=1e-6, high=1.0
    )
    replay: int = option(1_000_000, "Transitions kept to learn from.", low=1000, high=4_000_000)
    exploration: tuple[float, float] = option(
        (0.5, 0.008), "Chance of a random motion, of the boldest and of the most careful robot.", high=1.0
    )
    gap: float = option(
        0.6,
        "The target of an action is lowered by this share of what its value lacks to that of the best one.",
        high=1.0,
    )
    evaluate_every: int = option(
        1000, "Updates between two measurements; each also saves a checkpoint.", low=1, high=1_000_000
    )
    evaluation_starts: int = option(1000, "Starts of a measurement.", low=1, high=100_000)


METHOD = Method(
    "Learned in minutes by deep Q-learning, as in the paper. For the formulas that `reachability` takes.",
    Settings,
    lazily("specshield.policy.dqn.policy:check"),
    lazily("specshield.policy.dqn.train:train"),
    lazily("specshield.policy.dqn.policy:load_dqn"),
    needs=("torch",),
)
