"""A robot on whole cells, small enough to try every future: the independent answer to what is feasible.

The robot stands on the centres of a few cells of 0.2 m and looks north, south, east or west. Its moves are
worked out here on integers, the formula by `keeps` on booleans, without the package's dynamics or its STL.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from specshield.robot import robot_from_json
from specshield.robot.dynamics import make_body
from specshield.shield.proposal import Proposal
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid

CELL = 0.2
FORWARD, LEFT, RIGHT, WAIT, END = range(5)
ROBOT = robot_from_json(
    {
        "footprint": {"radius": 0.09},
        "actions": [
            {"name": "forward", "translate": CELL},
            {"name": "left", "rotate": math.pi / 2},
            {"name": "right", "rotate": -math.pi / 2},
            {"name": "wait"},
            {"name": "end", "terminal": True},
        ],
    }
)
WALLS = ["....#", ".#...", ".....", ".#.#.", "....."]  # the first row is y = 0
MOTIONS = 4


STATES = list(itertools.product(range(5), range(5), range(4)))  # column, row, quarter turns from east


@lru_cache
def ways(n):
    """Every list of n motions."""
    return np.array(list(itertools.product(range(MOTIONS), repeat=n)))


@dataclass(frozen=True)
class Cells:
    """A formula on the cells. regions: {name: (column, row)}, one cell each.

    keeps: {name: bool[..., T + 1]} -> bool[...], the formula on "is inside"; it is `formula`, written again.
    """

    formula: str
    keeps: object
    regions: dict[str, tuple[int, int]]
    signals: dict[str, float] = field(default_factory=dict)
    task: object = field(init=False)
    body: object = field(init=False)
    table: object = field(init=False)  # state and motion to state, as indices

    def __post_init__(self):
        occupied = np.array([[c == "#" for c in row] for row in WALLS])
        regions = {
            name: {"type": "rectangle", "min": [i * CELL, j * CELL], "max": [(i + 1) * CELL, (j + 1) * CELL]}
            for name, (i, j) in self.regions.items()
        }
        task = make_task(OccupancyGrid(occupied, CELL), ROBOT, self.formula, regions, signals=self.signals)
        object.__setattr__(self, "task", task)
        object.__setattr__(self, "body", make_body(ROBOT, task.grid))
        table = [[STATES.index(self.after(state, m)) for m in range(MOTIONS)] for state in STATES]
        object.__setattr__(self, "table", np.array(table))

    def pose(self, i, j, heading):
        """heading: quarter turns from east."""
        return np.array(
            [(i + 0.5) * CELL, (j + 0.5) * CELL, math.remainder(heading * math.pi / 2, 2 * math.pi)]
        )

    def state(self, pose):
        i, j = int(pose[0] // CELL), int(pose[1] // CELL)
        return i, j, round(pose[2] / (math.pi / 2)) % 4

    def after(self, state, motion):
        i, j, heading = state
        if motion in (LEFT, RIGHT):
            return i, j, (heading + (1 if motion == LEFT else -1)) % 4
        if motion == FORWARD:
            ni, nj = i + (1, 0, -1, 0)[heading], j + (0, 1, 0, -1)[heading]
            if 0 <= ni < 5 and 0 <= nj < 5 and WALLS[nj][ni] != "#":
                return ni, nj, heading
        return state

    def futures(self, history):
        """Every continuation: motions [N, n] and whether history and it keep the formula, bool[N]."""
        past = [self.state(pose) for pose in history]
        motions = ways(self.task.horizon + 1 - len(past))
        cells = np.empty((len(motions), self.task.horizon + 1, 2), int)
        cells[:, : len(past)] = np.array(past)[:, :2]
        now = np.full(len(motions), STATES.index(past[-1]))
        for k, column in enumerate(motions.T):
            now = self.table[now, column]
            cells[:, len(past) + k] = np.array(STATES)[now, :2]
        inside = {name: (cells == np.array(cell)).all(axis=-1) for name, cell in self.regions.items()}
        return motions, self.keeps(inside)

    def feasible(self, history):
        """S_t by enumeration: which motions have a future that keeps the formula. bool[MOTIONS]."""
        motions, kept = self.futures(history)
        return np.array([kept[motions[:, 0] == m].any() for m in range(MOTIONS)])

    def kept(self, history):
        cells = np.array([self.state(pose)[:2] for pose in history[: self.task.horizon + 1]])
        return bool(
            self.keeps({name: (cells == np.array(c)).all(axis=-1) for name, c in self.regions.items()})
        )


class Exhaustive:
    """A perfect proposer: for each motion a future that keeps the formula, if any does, drawn at random."""

    id = "exhaustive"

    def __init__(self, cells, seed=0):
        self.cells, self.task, self.random = cells, cells.task, np.random.default_rng(seed)

    def propose(self, history, signals, margin):
        motions, kept = self.cells.futures(history)
        rows = []
        for m in range(MOTIONS):
            good = np.flatnonzero((motions[:, 0] == m) & kept)
            rows.append(motions[self.random.choice(good)] if len(good) else motions[motions[:, 0] == m][-1])
        good = motions[kept]
        preferred = int(self.random.choice(good)[0]) if len(good) else WAIT
        return Proposal(np.array(rows), preferred)


class Scripted:
    """A proposer that does what it is told: `script(t, motion)` gives the motions that follow a first one."""

    id = "scripted"

    def __init__(self, cells, script, preferred=WAIT):
        self.cells, self.task, self.script, self.preferred = cells, cells.task, script, preferred

    def propose(self, history, signals, margin):
        t, n = len(history) - 1, self.task.horizon + 1 - len(history)
        rows = [([m, *self.script(t, m)] + [WAIT] * n)[:n] for m in range(MOTIONS)]
        return Proposal(np.array(rows), self.preferred)


def waits(t, motion):
    return []
