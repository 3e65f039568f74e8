"""Worlds small enough to try every future: random walls, regions and windows, and the exact feasible set.

From one start every pose that any motions lead to is visited, once for each progress of the formula; what
can still be kept is then known backward from the horizon. The progress is worked out here, on "is inside".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.judge import distance
from specshield.policy.dqn.environment import free_poses
from specshield.robot import robot_from_json
from specshield.robot.dynamics import make_body, motion_count, successors
from specshield.task import Task, make_task
from specshield.world.occupancy import OccupancyGrid

Floats = NDArray[np.float64]
Progress = tuple[int, ...]
Key = tuple[int, int, int, int, Progress]
DONE = -1
NEAR = 5  # [steps] of slack
MAX_NODES = 250_000


@dataclass(frozen=True)
class Kind:
    """A robot and its rooms. whole_cells: motions lead from cell centre to cell centre."""

    name: str
    turn: int  # degrees
    move: float
    size: int  # cells of `resolution` a side
    resolution: float
    horizon: int
    pitch: float
    whole_cells: bool


KINDS = (
    Kind("whole cells, 90 degrees", 90, 0.2, 7, 0.2, 20, 0.2, True),
    Kind("0.2 m moves, 30 degrees", 30, 0.2, 14, 0.1, 18, 0.1, False),
)


@dataclass(frozen=True)
class Part:
    """An obligation on "is inside any of `regions`" (or none of them): F[a,b], G[a,b] or F[a,c1] G[c2,b]."""

    kind: str  # "F", "G" or "FG"
    a: int
    b: int
    regions: str
    inside: bool = True
    c1: int = 0
    c2: int = 0

    @property
    def text(self) -> str:
        names = " or ".join(self.regions)
        predicate = f"({names})" if self.inside else f"not ({names})"
        if self.kind == "FG":
            return f"F[{self.a},{self.c1}] G[{self.c2},{self.b}] {predicate}"
        return f"{self.kind}[{self.a},{self.b}] {predicate}"

    def advance(self, t: int, holds: bool, done: int) -> int | None:
        """The progress after step t: DONE, or how long a dwell has lasted; None where it is broken."""
        if done == DONE:
            return DONE
        if self.kind == "F":
            return DONE if holds and self.a <= t <= self.b else None if t >= self.b else 0
        if self.kind == "G":
            return None if not holds and self.a <= t <= self.b else DONE if t >= self.b else 0
        lasted = done + 1 if holds and t >= self.a + self.c2 else 0
        if lasted >= self.b - self.c2 + 1 and t >= self.a + self.b:
            return DONE
        return None if t >= self.c1 + self.b else lasted


Draw = Callable[[int, int], int]  # a step from low to high, both included


def _in_turn(T: int, draw: Draw) -> list[Part]:
    middle = draw(T // 3, T // 2)
    return [Part("F", 0, middle, "A"), Part("F", middle, T, "B"), Part("G", 0, T, "C", inside=False)]


def _one_always(T: int, draw: Draw) -> list[Part]:
    return [Part("F", draw(0, T // 2), T, "A"), Part("G", 0, T, "B", inside=False)]


def _late_always(T: int, draw: Draw) -> list[Part]:
    return [
        Part("F", 0, T, "A"),
        Part("G", 0, draw(3, T // 2), "B", inside=False),
        Part("G", draw(T // 2, T - 2), T, "C", inside=False),
    ]


def _dwell(T: int, draw: Draw) -> list[Part]:
    long = draw(2, 3)
    return [Part("FG", 1, long, "A", c1=draw(T // 2, T - long - 1)), Part("F", T // 2, T, "B")]


def _overlap(T: int, draw: Draw) -> list[Part]:
    return [
        Part("F", draw(0, 2), draw(T // 2, T - 2), "A"),
        Part("F", draw(1, 3), T, "B"),
        Part("F", draw(2, T // 2), T, "C"),
    ]


def _one_for_two(T: int, draw: Draw) -> list[Part]:
    middle = draw(T // 3, T // 2)
    return [Part("F", 0, middle, "AB"), Part("F", middle, T, "A"), Part("F", middle - 1, T, "BA")]


def _either(T: int, draw: Draw) -> list[Part]:
    middle = draw(T // 3, T // 2)
    return [Part("F", 0, middle, "AB"), Part("F", middle + 1, T, "BC")]


SHAPES: dict[str, Callable[[int, Draw], list[Part]]] = {
    "F in turn, G": _in_turn,
    "F, G throughout": _one_always,
    "F, G that ends, G that begins late": _late_always,
    "F G, a dwell": _dwell,
    "F with overlapping windows": _overlap,
    "one visit for two": _one_for_two,
    "F of a disjunction": _either,
}


@dataclass(frozen=True)
class World:
    """parts: the formula of `task`; start: x_0."""

    kind: Kind
    shape: str
    parts: list[Part]
    regions: dict[str, Any]
    task: Task
    start: Floats


def make_world(kind: Kind, shape: str, seed: int) -> World:
    """Random walls (one cell in six), three regions, windows and start; one seed decides all."""
    random = np.random.default_rng([seed, KINDS.index(kind), list(SHAPES).index(shape)])
    spread = kind.size * kind.resolution
    if kind.whole_cells:
        occupied = random.random((kind.size, kind.size)) < 1 / 6
        radius, corners = 0.09, random.integers(0, kind.size, (3, 2)) * 0.2 + 1e-3
        sides = np.full(3, 0.198)
    else:
        occupied = np.zeros((kind.size, kind.size), bool)
        row, door = random.integers(5, 9), random.integers(0, 10)
        occupied[row] = True
        occupied[row, door : door + 4] = False
        radius, corners = 0.1, random.uniform(0.1, spread - 0.45, (3, 2))
        sides = random.uniform(0.25, 0.35, 3)
    robot = robot_from_json(
        {
            "footprint": {"radius": radius},
            "actions": [
                {"name": "forward", "translate": kind.move},
                {"name": "left", "rotate": math.radians(kind.turn)},
                {"name": "right", "rotate": -math.radians(kind.turn)},
                {"name": "wait"},
            ],
        }
    )
    regions = {
        name: {"type": "rectangle", "min": corner.tolist(), "max": (corner + side).tolist()}
        for name, corner, side in zip("ABC", corners, sides, strict=True)
    }
    parts = SHAPES[shape](kind.horizon, lambda low, high: int(random.integers(low, high + 1)))
    formula = " and ".join(part.text for part in parts)
    task = make_task(OccupancyGrid(occupied, kind.resolution), robot, formula, regions)
    start = free_poses(task, make_body(robot, task.grid), 1, random)[0]
    if kind.whole_cells:
        free = np.argwhere(~occupied)
        j, i = free[random.integers(len(free))]
        start = np.array([(i + 0.5) * 0.2, (j + 0.5) * 0.2, random.integers(-1, 3) * math.pi / 2])
    return World(kind, shape, parts, regions, task, start)


@dataclass(frozen=True)
class Exact:
    """Every state that can be reached, a layer a step.

    poses, parents (key of the layer before, None at x_0), after (the key that each motion leads to, None
    where it breaks the formula), good (whether the formula can still be kept).
    """

    poses: list[dict[Key, Floats]]
    parents: list[dict[Key, Key | None]]
    after: list[dict[Key, list[Key | None]]]
    good: list[dict[Key, bool]]

    def history(self, t: int, key: Key) -> Floats:
        states, at = [], key
        for layer in range(t, -1, -1):
            states.append(self.poses[layer][at])
            parent = self.parents[layer][at]
            if parent is not None:
                at = parent
        return np.array(states[::-1])

    def feasible(self, t: int, key: Key) -> NDArray[np.bool_]:
        """S_t, exactly: for each motion whether some future keeps the formula."""
        return np.array([k is not None and self.good[t + 1][k] for k in self.after[t][key]])

    def slack(self, t: int, key: Key, wait: int) -> int:
        """For how many steps the robot can wait and still keep it."""
        steps, at = 0, key
        while t + steps < len(self.after):
            onward = self.after[t + steps][at][wait]
            if onward is None or not self.good[t + steps + 1][onward]:
                return steps
            steps, at = steps + 1, onward
        return steps


def explore(world: World) -> Exact | None:
    """None where there are more than MAX_NODES states, or none that can keep the formula."""
    body, horizon = make_body(world.task.robot, world.task.grid), world.task.horizon
    motions = motion_count(body)

    def onward(t: int, pose: Floats, progress: Progress) -> Key | None:
        inside = {name: float(distance(region, pose)) > 0.0 for name, region in world.regions.items()}
        new = []
        for part, done in zip(world.parts, progress, strict=True):
            holds = any(inside[name] for name in part.regions) is part.inside
            advanced = part.advance(t, holds, done)
            if advanced is None:
                return None
            new.append(advanced)
        x, y, theta = pose.tolist()
        where = (round(1e6 * v) for v in (x, y, math.cos(theta), math.sin(theta)))
        return (*where, tuple(new))  # type: ignore[return-value]

    first = onward(0, world.start, (0,) * len(world.parts))
    if first is None:
        return None
    poses, parents = [{first: world.start}], [dict[Key, Key | None]({first: None})]
    after: list[dict[Key, list[Key | None]]] = []
    nexts = np.empty((motions, 3))
    for t in range(horizon):
        layer: dict[Key, Floats] = {}
        above: dict[Key, Key | None] = {}
        after.append({})
        for key, pose in poses[t].items():
            successors(body, pose, nexts)
            after[t][key] = keys = [onward(t + 1, nexts[m], key[-1]) for m in range(motions)]
            for m, found in enumerate(keys):
                if found is not None and found not in layer:
                    layer[found], above[found] = nexts[m].copy(), key
        poses.append(layer)
        parents.append(above)
        if len(layer) > MAX_NODES:
            return None
    good = [dict.fromkeys(poses[horizon], True)]
    for t in range(horizon - 1, -1, -1):
        good.insert(
            0, {key: any(k is not None and good[0][k] for k in keys) for key, keys in after[t].items()}
        )
    return Exact(poses, parents, after, good) if good[0][first] else None


def sample(exact: Exact, wait: int, n: int, random: np.random.Generator) -> Iterator[tuple[int, Key, int]]:
    """n states (t, key, slack) that can keep the formula with something still to lose, half of them with
    at most NEAR steps of slack where there are such.
    """
    states = [
        (t, key)
        for t in range(len(exact.after))
        for key in exact.after[t]
        if exact.good[t][key] and any(done != DONE for done in key[-1])
    ]
    states = [states[i] for i in random.permutation(len(states))]
    near, far = [], []
    for t, key in states:
        slack = exact.slack(t, key, wait)
        kept = near if slack <= NEAR else far
        if len(kept) < n // 2:
            kept.append((t, key, slack))
        if len(near) == len(far) == n // 2:
            break
    yield from near
    yield from far
