"""The learned foundation model: it imitates shortest paths, as SPOC does, and knows no rule and no region.

Its input is a range scan, whether and where its target is seen, what it has to find, and the last executed
action, which the shield may have chosen. It has its own memory, and its own count of where it is since it
began (reckoning.py). The shipped weights were trained only in generated apartments, with interference like a
shield's (evaluation/model/practice.py); the card has the figures.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from specshield.arrays import Floats, Singles
from specshield.errors import NotFound, PolicyError
from specshield.policy.tensors import read_tensors
from specshield.shipped import MODELS
from specshield.sim.learned.network import KINDS, NOTHING, Network, check, decoded, features
from specshield.sim.learned.reckoning import Reckoning
from specshield.sim.robot import SimulatedRobot

FOLDER, WEIGHTS, CARD = "fm", "model.safetensors", "model.json"  # in models/


class LearnedModel:
    """weights: as `check` returns them. target: one of KINDS. temperature: by which logits are divided."""

    def __init__(self, weights: Mapping[str, Singles], target: str, temperature: float) -> None:
        self._network, self._kind, self._temperature = Network(weights), KINDS.index(target), temperature
        self._reckoning = Reckoning(1)

    def reset(self, random: np.random.Generator) -> None:
        """Forgets the last episode. The model does not use `random`."""
        self._network.reset()
        self._reckoning = Reckoning(1)

    def logits(self, robot: SimulatedRobot) -> Floats:
        """Finite logits (A,) for the next action."""
        senses = robot.sense()
        seen = (float(senses.seen), senses.distance, senses.bearing)
        last = NOTHING if senses.last_action is None else senses.last_action
        lasts = np.array([last])
        self._reckoning.count(senses.ranges[None], lasts)
        place = self._reckoning.place[0]
        x = features(np.array([*senses.ranges, *seen]), place[2])
        raw = self._network.step(x, place, last, self._kind)
        out: Floats = decoded(raw[None], lasts, self._reckoning.futile, self._temperature)[0]
        return out


def load_learned(instruction: str, folder: Path = MODELS / FOLDER) -> LearnedModel:
    """The model in `folder`, with an instruction. Raises NotFound, PolicyError."""
    shipped = read(folder)
    return LearnedModel(shipped.weights, target_of(instruction), shipped.temperature)


def target_of(instruction: str) -> str:
    """The kind of thing that an instruction names. Raises NotFound."""
    named = [kind for kind in KINDS if kind in re.findall(r"\w+", instruction.lower())]
    if len(named) != 1:
        told = f"the learned model does not know what to find: {instruction!r}"
        expected = f"a sentence with one of {', '.join(KINDS)}"
        raise NotFound(told, path="instruction", got=instruction, expected=expected)
    return named[0]


class Shipped(NamedTuple):
    """The content of a model's folder: checked weights, temperature, and the card."""

    weights: dict[str, Singles]
    temperature: float
    card: dict[str, Any]


@lru_cache(maxsize=4)
def read(folder: Path) -> Shipped:
    """Reads a model from its folder. Raises NotFound, PolicyError."""
    path = folder / WEIGHTS
    if not path.is_file():
        raise NotFound(
            "there is no learned model", path="model", got=str(folder), expected=f"{WEIGHTS} and {CARD}"
        )
    card, weights = json.loads((folder / CARD).read_text()), check(read_tensors(path))
    value = card.get("temperature") if isinstance(card, dict) else None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.05 <= value <= 20.0:
        raise PolicyError(
            "not a temperature", path="card.temperature", got=value, expected="a number from 0.05 to 20"
        )
    return Shipped(weights, float(value), card)
