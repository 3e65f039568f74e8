"""What a training run may be told. Apart from dqn.py, so that asking for a policy needs no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from specshield.errors import PolicyError


@dataclass(frozen=True)
class Settings:
    """Of a DQN. `reward` is `progress` or `paper` (policy/funnel.py)."""

    reward: str = "progress"
    units: int = 64
    updates: int = 16_000
    robots: int = 512
    batch: int = 1024
    learning_rate: float = 1e-3
    discount: float = 0.98
    returns: int = 5  # steps of an n-step return
    polyak: float = 0.02
    replay: int = 1_000_000  # transitions
    exploration: tuple[float, float] = (0.5, 0.008)  # each robot's own constant chance of a random motion
    gap: float = 0.6  # share of an action's loss against the best one that is taken off its target
    evaluate_every: int = 1000  # updates
    evaluation_starts: int = 1000


LIMITS: dict[str, tuple[float, float]] = {
    "units": (4, 128), "updates": (1, 1_000_000), "robots": (1, 4096), "batch": (1, 65536),
    "learning_rate": (1e-7, 1.0), "discount": (0.0, 1.0), "returns": (1, 64), "polyak": (1e-6, 1.0),
    "gap": (0.0, 1.0), "replay": (1000, 4_000_000), "evaluate_every": (1, 1_000_000),
    "evaluation_starts": (1, 100_000),
}  # fmt: skip


def options_of(settings: Settings) -> dict[str, Any]:
    """The settings as JSON, complete: what a policy's id is hashed from. `read_settings` reads them back."""
    return asdict(settings) | {"exploration": list(settings.exploration)}


def read_settings(options: Mapping[str, Any]) -> Settings:
    """Settings from JSON, those left out at their defaults. Raises PolicyError with the option's path."""
    return Settings(**{name: _read(name, value) for name, value in options.items()})


def _read(name: str, value: Any) -> Any:
    path, defaults = f"options.{name}", {f.name: f.default for f in fields(Settings)}
    if name not in defaults:
        raise PolicyError(
            f"unknown option {name!r}", path=path, got=name, expected=f"one of {sorted(defaults)}"
        )
    if name == "reward":
        if value not in ("progress", "paper"):
            raise PolicyError("unknown reward", path=path, got=value, expected="'progress' or 'paper'")
        return value
    if name == "exploration":
        if (
            not isinstance(value, (list, tuple))
            or len(value) != 2
            or not all(_within(v, 0.0, 1.0) for v in value)
        ):
            raise PolicyError(
                "not two chances", path=path, got=value, expected="[highest, lowest], from 0 to 1"
            )
        return tuple(value)
    low, high = LIMITS[name]
    whole = isinstance(defaults[name], int)
    if not _within(value, low, high) or (whole and not isinstance(value, int)):
        expected = f"{'a whole number' if whole else 'a number'} from {low:g} to {high:g}"
        raise PolicyError("not in range", path=path, got=value, expected=expected)
    return value if whole else float(value)


def _within(value: Any, low: float, high: float) -> bool:
    return not isinstance(value, bool) and isinstance(value, (int, float)) and low <= value <= high
