"""Narrow predicates: of the starts that an exact search finds feasible, how many are accepted, and kept.

    python -m benchmarks.narrow [--n 500] [--seed 0] [--method reachability] [--robot restless] [--episodes 1]

Houses are drawn (evaluation/model/floor_plans.py), a new one for every ten rules. A rule asks the Stretch to
be, once or for some steps, where a narrow predicate holds: a disc with a radius from 0.02 m, a strip, a
window of headings from 2 degrees, or a disc with such a window. Start and deadline are random. The restless
robot is a Stretch that cannot wait; it is asked to be there once. The search
(exact.py) shares no code with the policies. Of the accepted starts, an episode of a model that draws its
logits at random is run to the end. Prints Markdown, one row for each kind of predicate, with 95 % intervals.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from benchmarks.exact import MOST, NOWHERE, Goal, fewest_steps
from evaluation.model.floor_plans import random_house
from evaluation.statistics import clopper_pearson
from specshield.episode import Shield, decide, make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.robot import STRETCH, Robot, robot_from_json
from specshield.robot.dynamics import make_body
from specshield.task import make_task

Floats = NDArray[np.float64]
DWELL = 5  # [steps] where the predicate has to hold for some
Random = np.random.Generator


def disc(random: Random, at: Floats, smallest: float, largest: float) -> Goal:
    radius = math.exp(random.uniform(math.log(smallest), math.log(largest)))
    return Goal(x=round(float(at[0]), 3), y=round(float(at[1]), 3), radius=round(radius, 4))


def window(random: Random) -> tuple[float, float]:
    """Headings, 2 to 12 degrees of them, anywhere on the circle but not across the wrap."""
    half = math.radians(random.uniform(1.0, 6.0))
    centre = random.uniform(-math.pi + half, math.pi - half)
    if random.random() < 0.2:  # at the wrap
        centre = math.copysign(math.pi - half, centre)
    return round(centre - half, 4), round(centre + half, 4)


def strip(random: Random, at: Floats) -> Goal:
    axis, width = int(random.integers(2)), random.uniform(0.02, 0.12)
    bounds = (round(float(at[axis]) - width / 2, 3), round(float(at[axis]) + width / 2, 3))
    return Goal(xs=bounds) if axis == 0 else Goal(ys=bounds)


KINDS: dict[str, Callable[[Random, Floats], Goal]] = {
    "place": lambda random, at: disc(random, at, 0.02, 0.15),
    "heading": lambda random, at: Goal(theta=window(random)),
    "strip": strip,
    "dock": lambda random, at: disc(random, at, 0.02, 0.6)._replace(theta=window(random)),
}


def restless() -> Robot:
    """The motions of the Stretch without the one that waits."""
    motions = [motion for motion in STRETCH.motions if motion != (0.0, 0.0)]
    actions = [
        {"name": f"{move:g} {turn:.3f}", "translate": move, "rotate": turn} for move, turn in motions
    ] + [{"name": "end", "terminal": True}]
    footprint = {"radius": STRETCH.radius, "offset": list(STRETCH.offset)}
    return robot_from_json({"footprint": footprint, "on_contact": "stop", "actions": actions})


ROBOTS = {"stretch": lambda: STRETCH, "restless": restless}


def runs(
    shield: Shield, pose: Floats, goal: Goal, dwell: int, by: int, random: Random
) -> tuple[bool, list[float]]:
    """Whether an episode from a pose keeps the rule, by the goal's own geometry; [ms] of each decision."""
    poses, carry, took, robot = [pose], None, list[float](), shield.task.robot
    while len(poses) <= shield.task.horizon:
        logits = np.where(robot.terminal, -np.inf, random.normal(0.0, 3.0, len(robot.actions)))
        began = time.perf_counter()
        decision = decide(shield, poses, logits, carry=carry)
        took.append(1e3 * (time.perf_counter() - began))
        poses.append(decision.next_poses[decision.action])
        carry = decision.carry
    holds = goal.holds(np.array(poses))
    ends = [t for t in range(by + 1) if holds[t : t + dwell + 1].all() and t + dwell < len(poses)]
    return bool(ends), took


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--n", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--method", default="reachability", choices=("reachability", "planner"))
    parser.add_argument("--robot", default="stretch", choices=tuple(ROBOTS))
    parser.add_argument("--episodes", type=int, default=1, help="0 or 1 for each accepted start")
    asked = parser.parse_args()
    robot = ROBOTS[asked.robot]()
    method = import_module(f"specshield.policy.{asked.method}.policy")
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    times: dict[str, list[float]] = defaultdict(list)
    for n in range(asked.n):
        random = np.random.default_rng([asked.seed, n])
        house = random_house(np.random.default_rng([asked.seed, n // 10, 1]))
        body = make_body(robot, house.grid)
        kind = list(KINDS)[n % len(KINDS)]
        plain = make_task(house.grid, robot, "F[0,1] x > 0")
        pose, at = free_poses(plain, body, 2, random)
        goal, by = KINDS[kind](random, at), int(random.integers(20, 121))
        dwell = DWELL if random.random() < 0.3 and robot.wait_motion >= 0 else 0
        formula = f"F[0,{by}] G[0,{dwell}] {goal.formula()}" if dwell else f"F[0,{by}] {goal.formula()}"
        regions = {"Dock": {"type": "circle", "center": [goal.x, goal.y], "radius": goal.radius}}
        task = make_task(house.grid, robot, formula, regions if goal.radius < math.inf else {})
        began = time.perf_counter()
        least = fewest_steps(body, goal, *map(float, pose), by, MOST, NOWHERE)
        searched = time.perf_counter() - began
        policy = method.synthesise(task)
        made = time.perf_counter() - began - searched
        shield, accepted = make_shield([policy]), True
        began = time.perf_counter()
        try:
            start(shield, pose.tolist())
        except InfeasibleStart:
            accepted = False
        took = time.perf_counter() - began
        found = counts[kind]
        found["rules"] += 1
        found["feasible"] += least >= 0
        found["accepted of these"] += accepted and least >= 0
        found["accepted beyond"] += accepted and least < 0
        times[f"start {kind}"].append(1e3 * took)
        times[f"made {kind}"].append(made)
        if least >= 0 and not accepted:
            print(
                f"missed {n}: {formula} {regions} from {pose.tolist()}, needs {least}, {took:.1f} s",
                flush=True,
            )
        if accepted and asked.episodes:
            kept, ms = runs(shield, pose, goal, dwell, by, random)
            found["episodes"] += 1
            found["kept"] += kept
            times[f"ms {kind}"] += ms
            if not kept:
                print(f"broken {n}: {formula} {regions} from {pose.tolist()}", flush=True)
    show(counts, times)


COLUMNS = (
    "predicate", "feasible", "accepted", "share", "accepted beyond the search", "episodes", "kept",
    "made [s]", "start [ms]", "decision [ms]: median / p99 / most",
)  # fmt: skip


def show(counts: dict[str, Counter[str]], times: dict[str, list[float]]) -> None:
    print("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|")
    for kind in (*counts, "all"):
        found = counts[kind] if kind != "all" else sum(counts.values(), Counter[str]())
        made, begun, ms = (
            [v for each in counts if kind in (each, "all") for v in times[f"{what} {each}"]] or [math.nan]
            for what in ("made", "start", "ms")
        )
        accepted, feasible = found["accepted of these"], found["feasible"]
        low, high = clopper_pearson(accepted, feasible)
        print(
            f"| {kind} | {feasible} | {accepted} | {accepted / max(feasible, 1):.3f} [{low:.3f}, {high:.3f}] "
            f"| {found['accepted beyond']} | {found['episodes']} | {found['kept']} | {np.median(made):.2f} "
            f"| {np.median(begun):.0f} | {np.median(ms):.1f} / {np.quantile(ms, 0.99):.0f} / {max(ms):.0f} |"
        )


if __name__ == "__main__":
    main()
