"""Rules that answer signals: whether what is guaranteed against any signal is kept, and how often the rest.

    python -m benchmarks.reactions [--runs 200] [--houses 2] [--seed 0] [--only RULE]

Houses and the places in them are drawn by seed. Each run begins at a random pose. Half of the models walk at
random, half walk away from every place that a call may ask for. Three times over the same start:

    random   each signal rises at a random step and falls after a random time, again and again
    worst    silence up to the moment at which, in a silent run of the same model, the robot is farthest
             from a place that may be asked for; then all signals rise and stay. Three such moments are
             tried, and the run is kept where all three are

`guaranteed` are the starts from which the shield says, before the first sample, that the rule is kept
whatever the signals do. `silence` and `any signal` are the policy's own figures, over starts of its own. Kept
or not is judged by the definition of robustness on what was driven. 95 % intervals.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evaluation.model.floor_plans import random_house
from evaluation.statistics import clopper_pearson
from specshield.caution.signals import any_signal
from specshield.episode import decide
from specshield.policy.dqn.environment import free_poses
from specshield.policy.geodesic import geodesic_distance
from specshield.policy.planner.policy import synthesise
from specshield.robot import STRETCH
from specshield.robot.dynamics import make_body, successors
from specshield.shield.decision import Carry, Config, Shield, make_shield
from specshield.stl import robustness
from specshield.task import Task, make_task
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Circle

Floats = NDArray[np.float64]
Random = np.random.Generator
RULES = {
    "one place": "G[0,80] (call > 0.5 -> F[0,60] Dock)",
    "soon": "G[0,80] (call > 0.5 -> F[0,25] Dock)",
    "a place in the way": "G[0,80] (call > 0.5 -> F[0,60] Dock) and G[0,140] not touches(Wet)",
    "a visit": "G[0,60] (call > 0.5 -> F[0,70] Dock) and F[40,130] Shelf",
    "two calls": "G[0,60] (call > 0.5 -> F[0,70] Dock) and G[20,60] (alarm > 0.5 -> F[0,80] Door)",
    "a patrol": "G[0,60] (call > 0.5 -> F[0,80] Dock) and G[0,60] F[0,80] Shelf",
}
PLACES = {"Dock": 0.5, "Shelf": 0.5, "Door": 0.5, "Wet": 0.3}  # radii [m]
APART = 1.5  # [m] between the centres
MOMENTS = 3  # at which the signals rise
BETWEEN = 10  # steps between two of them, at least


def places(grid: OccupancyGrid, random: Random) -> dict[str, dict[str, object]]:
    empty = make_task(grid, STRETCH, "F[0,1] x > 0")
    body, found = make_body(STRETCH, grid), list[Floats]()
    while len(found) < len(PLACES):
        pose = free_poses(empty, body, 1, random)[0][:2]
        if all(np.hypot(*(pose - other)) > APART for other in found):
            found.append(pose)
    return {
        name: {"type": "circle", "center": centre.tolist(), "radius": radius}
        for (name, radius), centre in zip(PLACES.items(), found, strict=True)
    }


class Away:
    """A model that walks away from the places that a call may ask for, or, with no pull, at random."""

    def __init__(self, shield: Shield, pull: float, seed: int) -> None:
        self.body, self.pull, self.random = shield.body, pull, np.random.default_rng(seed)
        self.grid, asked = shield.task.grid, [n for n in ("Dock", "Door") if n in shield.task.regions]
        self.far = list[Floats]()
        for area in (shield.task.regions[name] for name in asked):
            assert isinstance(area, Circle)
            inside = np.hypot(*np.moveaxis(self.grid.centres - area.center, -1, 0)) < area.radius
            self.far.append(geodesic_distance(~self.grid.occupied, inside, self.grid.resolution))

    def distance(self, pose: Floats) -> float:
        """[m] along free space to the farthest of the places."""
        u, v = self.grid.to_grid(pose[:2])
        row, column = int(v / self.grid.resolution), int(u / self.grid.resolution)
        return max(float(far[row, column]) for far in self.far)

    def logits(self, pose: Floats) -> Floats:
        nexts = np.empty((len(STRETCH.motions), 3))
        successors(self.body, pose, nexts)
        pulls = [self.pull * self.distance(each) for each in nexts]
        logits = self.random.normal(0.0, 2.0, len(STRETCH.actions))
        logits += np.where(STRETCH.motion_of < 0, 0.0, np.array(pulls)[STRETCH.motion_of])
        logits[STRETCH.terminal] = -np.inf
        return logits


@dataclass
class Run:
    """poses [T + 1, 3]; signals {name: [T + 1]}; carries: after each decision."""

    poses: list[Floats]
    signals: Mapping[str, Floats]
    carries: list[Carry | None]

    def kept(self, task: Task) -> bool:
        samples = task.samples(np.array(self.poses), self.signals)
        return bool(robustness(task.formula, {name: samples[name] for name in task.formula.names}) > 0.0)


def drive(shield: Shield, model: Away, begun: Run, signals: Mapping[str, Floats]) -> Run:
    """The run that goes on from what has begun, under signals that are the same so far."""
    poses, carries = list(begun.poses), list(begun.carries)
    while len(poses) <= shield.task.horizon:
        seen = {name: values[: len(poses)] for name, values in signals.items()}
        decision = decide(shield, poses, model.logits(poses[-1]), signals=seen, carry=carries[-1])
        carries.append(decision.carry)
        poses.append(decision.next_poses[decision.action])
        if decision.spec_status != "pending":  # whatever follows
            poses += [poses[-1]] * (shield.task.horizon + 1 - len(poses))
    return Run(poses, signals, carries)


def at_random(task: Task, random: Random) -> dict[str, Floats]:
    """Signals that rise and fall."""
    found = {}
    for name in task.signals:
        values, up = np.zeros(task.horizon + 1), False
        t = int(random.integers(0, 40))
        while t <= task.horizon:
            up = not up
            values[t:] = float(up)
            t += int(random.integers(1, 40))
        found[name] = values
    return found


def rising(task: Task, t: int) -> dict[str, Floats]:
    return {name: (np.arange(task.horizon + 1) >= t).astype(np.float64) for name in task.signals}


def worst_moments(task: Task, model: Away, silent: Run) -> list[int]:
    """The steps at which the robot is farthest from a place that may be asked for."""
    last = max(80 if "G[0,80]" in str(task.formula) else 60, 1)
    far, found = [model.distance(pose) for pose in silent.poses[: last + 1]], list[int]()
    for t in np.argsort(far)[::-1].tolist():
        if all(abs(t - other) >= BETWEEN for other in found):
            found.append(t)
    return found[:MOMENTS]


def measure(name: str, grid: OccupancyGrid, house: str, runs: int, seed: int) -> str:
    random = np.random.default_rng(seed)
    regions = places(grid, random)
    signals = {signal: 0.0 for signal in ("call", "alarm") if signal in RULES[name]}
    policy = synthesise(make_task(grid, STRETCH, RULES[name], regions, signals=signals))
    task, figures = policy.task, policy.card["metrics"]
    outcomes: list[tuple[bool, bool, bool]] = []
    for i in range(runs):
        shield = make_shield([policy], Config(seed=seed + i, any_signal=True))
        pose, pull = free_poses(task, shield.body, 1, random)[0], 3.0 * (i % 2)
        guaranteed = any_signal(shield, pose[None]) is True

        def model(shield: Shield = shield, pull: float = pull, i: int = i) -> Away:
            return Away(shield, pull, seed + i)

        begun, silence = Run([pose], {}, [None]), rising(task, task.horizon + 1)
        kept = drive(shield, model(), begun, at_random(task, random)).kept(task)
        silent = drive(shield, model(), begun, silence)
        worst = True
        for t in worst_moments(task, model(), silent):
            upto = Run(silent.poses[: t + 1], silence, silent.carries[: t + 1])
            worst = worst and drive(shield, model(), upto, rising(task, t)).kept(task)
        outcomes.append((guaranteed, kept, worst))
    rows = np.array(outcomes)
    sure = rows[rows[:, 0]]
    cells = [f"{figures['feasible_start']:.2f}", f"{figures['feasible_start_any_signal']:.2f}"]
    cells += [f"{len(sure)} of {runs}"]
    for some in (sure, rows):
        cells += [_share(int(some[:, k].sum()), len(some)) for k in (1, 2)]
    return f"| {house} | {name} | " + " | ".join(cells) + " |"


def _share(kept: int, runs: int) -> str:
    if not runs:
        return "none"
    low, high = clopper_pearson(kept, runs)
    return f"{kept} of {runs} ({100 * low:.1f} to {100 * high:.1f} %)"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--houses", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    asked = parser.parse_args()
    heads = ["house", "rule", "silence", "any signal", "guaranteed", "guaranteed: random", "worst"]
    print("| " + " | ".join([*heads, "all: random", "worst"]) + " |")
    print("|" + "---|" * (len(heads) + 2))
    for house in range(asked.houses):
        grid = random_house(np.random.default_rng([asked.seed, house])).grid
        for name in RULES:
            if asked.only in name:
                print(measure(name, grid, str(house), asked.runs, asked.seed), flush=True)


if __name__ == "__main__":
    main()
