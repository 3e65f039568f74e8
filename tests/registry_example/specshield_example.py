"""A package that adds a method, a map format and a preference to specshield, none of whose files it
edits: `entry_points.txt` beside it says what it adds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from specshield.errors import MapError, PolicyError
from specshield.lookahead.preferences import PreferenceKind
from specshield.policy.card import Card, make_card
from specshield.policy.methods import Method, Run
from specshield.policy.options import option, options_to_json
from specshield.policy.tensors import read_tensors
from specshield.shield.proposal import Proposal
from specshield.task import Task
from specshield.world.formats import MapFormat
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Rectangle

Floats = NDArray[np.float64]


# --- a method: after whatever motion comes first, the robot repeats one motion to the horizon


@dataclass(frozen=True)
class Options:
    motion: int = option(0, "Index of the motion that is repeated.", low=0, high=255)


@dataclass(frozen=True)
class AheadPolicy:
    task: Task
    card: Card
    motion: int

    @property
    def id(self) -> str:
        return str(self.card["id"])

    def propose(self, history: Floats, signals: Mapping[str, Floats], margin: float) -> Proposal:
        count = len(self.task.robot.motions)
        motions = np.full((count, self.task.horizon + 1 - len(history)), self.motion, np.int64)
        motions[:, 0] = np.arange(count)
        return Proposal(motions, self.motion)

    def weights(self) -> bytes:
        return save({"motion": np.array([self.motion])})


def check(task: Task, options: Options) -> None:
    if options.motion >= len(task.robot.motions):
        raise PolicyError(
            "the robot has no such motion", path="options.motion", got=options.motion,
            expected=f"below {len(task.robot.motions)}",
        )  # fmt: skip


def make(task: Task, options: Options, run: Run) -> AheadPolicy:
    run.on_progress(1.0, 0.0, "nothing had to be learned")
    card = make_card(task, "ahead", options_to_json(options), run.seed, {}, run.spec)
    return AheadPolicy(task, card, options.motion)


def load(weights: bytes | Path, card: Card, task: Task) -> AheadPolicy:
    return AheadPolicy(task, card, int(read_tensors(weights)["motion"][0]))


METHOD = Method("Repeats one motion, whatever the rule.", Options, check, make, load)


# --- a map format: a drawing in characters


def read_drawing(rows: Any, resolution: float) -> tuple[OccupancyGrid, dict[str, Rectangle]]:
    """`#` is occupied; the first row is the highest y. The whole map is a room, `Everywhere`."""
    if not isinstance(rows, list) or len({len(row) for row in rows}) != 1:
        raise MapError("this is no drawing", path="rows", got=rows, expected="texts of one length")
    cells = np.array([[character == "#" for character in row] for row in rows])[::-1]
    grid = OccupancyGrid(cells, resolution)
    xmin, ymin, xmax, ymax = grid.bounds
    return grid, {"Everywhere": Rectangle((xmin, ymin), (xmax, ymax))}


FORMAT = MapFormat(
    "A drawing: one text a row, `#` where it is occupied.",
    {
        "rows": {"type": "array", "items": {"type": "string"}, "description": "From the highest y down."},
        "resolution": {"type": "number", "default": 0.1, "description": "Side of a cell [m]."},
    },
    read_drawing,
)


# --- a preference: the first action, more from step to step


@dataclass(frozen=True)
class Eager:
    actions: int

    def begin(self) -> bytes:
        return b""

    def step(
        self,
        memory: bytes,
        history: Floats,
        signals: Mapping[str, Floats],
        log_prior: Floats,
        feasible: NDArray[np.bool_],
    ) -> tuple[bytes, Floats]:
        memory += b"."
        return memory, len(memory) * (np.arange(self.actions) == 0).astype(np.float64)


def prepare(task: Task, proposers: Sequence[Any]) -> Eager:
    return Eager(len(task.robot.actions))


PREFERENCE = PreferenceKind("Wants the first action, more at every step.", prepare)
