"""`not A U[0,b] B` near its deadline: of the starts that an exact search finds feasible, those accepted.

    python -m benchmarks.deadlines [--n 200] [--seed 0] [--episodes 1]

Houses are drawn (evaluation/model/floor_plans.py), a new one for every ten starts. B is a disc or a small one
somewhere; A is a disc in the free space, most often on the straight line to B. The search (exact.py) shares
no code with the policies. It says in how many steps B can be reached outside A, and the deadline is that
step, or up to four later. Of the accepted starts, an episode of a model that draws its logits at random is
run to the end and measured by the discs themselves. Prints Markdown, one row for each number of steps to
spare, with 95 % intervals.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter, defaultdict
from typing import NamedTuple

import numpy as np

from benchmarks.exact import MOST, Floats, Goal, fewest_steps
from evaluation.model.floor_plans import House, random_house
from evaluation.statistics import clopper_pearson
from specshield.episode import Shield, decide, make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.policy.planner.policy import synthesise
from specshield.robot import STRETCH
from specshield.robot.dynamics import Body, make_body
from specshield.task import Task, make_task

SPARE = 5  # 0 to 4 steps between what the search needs and the deadline
FEWEST, LONGEST = 8, 120  # [steps] of the ways that are asked for
Random = np.random.Generator


class Drawn(NamedTuple):
    """A task, a start, and the discs B and A (1, 3) of its rule."""

    task: Task
    pose: Floats
    goal: Goal
    shut: Floats


def drawn(random: Random, house: House, spare: int) -> Drawn:
    """A rule whose deadline is `spare` steps after what the search needs."""
    body = make_body(STRETCH, house.grid)
    free = free_poses(make_task(house.grid, STRETCH, "F[0,1] x > 0"), body, 60, random)
    pose, goal, shut, least = _feasible(body, free, random)
    regions = {
        "A": {"type": "circle", "center": shut[0, :2].tolist(), "radius": float(shut[0, 2])},
        "B": {"type": "circle", "center": [goal.x, goal.y], "radius": goal.radius},
    }
    task = make_task(house.grid, STRETCH, f"not A U[0,{least + spare}] B", regions)
    return Drawn(task, pose, goal, shut)


def the(n: int, seed: int = 0) -> Drawn:
    """The nth of a seed's."""
    house = random_house(np.random.default_rng([seed, n // 10, 1]))
    return drawn(np.random.default_rng([seed, n]), house, n % SPARE)


def _feasible(body: Body, free: Floats, random: Random) -> tuple[Floats, Goal, Floats, int]:
    """A start, B, A, and the fewest steps that the search needs."""
    while True:
        pose, at, beside = free[random.choice(len(free), 3, replace=False)]
        goal = Goal(round(float(at[0]), 2), round(float(at[1]), 2), round(random.uniform(0.1, 0.6), 2))
        if random.random() < 0.7:
            beside = pose + random.uniform(0.3, 0.7) * (at - pose)
        shut = np.array([[*np.round(beside[:2], 2), round(random.uniform(0.2, 1.0), 2)]])
        if np.hypot(*(pose[:2] - shut[0, :2])) <= shut[0, 2]:
            continue
        x, y, theta = map(float, pose)
        least = fewest_steps(body, goal, x, y, theta, LONGEST, MOST, shut)
        if least >= FEWEST:
            return pose, goal, shut, least


def keeps(shield: Shield, pose: Floats, goal: Goal, shut: Floats, random: Random) -> bool:
    """Whether an episode from a pose keeps the rule, by the discs' own geometry."""
    poses, carry = [pose], None
    while len(poses) <= shield.task.horizon:
        logits = np.where(STRETCH.terminal, -np.inf, random.normal(0.0, 3.0, len(STRETCH.actions)))
        decision = decide(shield, poses, logits, carry=carry)
        poses.append(decision.next_poses[decision.action])
        carry = decision.carry
    there = np.flatnonzero(goal.holds(np.array(poses)))
    x, y, _ = np.array(poses)[: there[0] if len(there) else None].T
    return bool(len(there)) and bool(np.all(np.hypot(x - shut[0, 0], y - shut[0, 1]) > shut[0, 2]))


def main() -> None:
    parser = argparse.ArgumentParser(description="Starts of `until` near their deadline.")
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=1, help="0 or 1 for each accepted start")
    asked = parser.parse_args()
    counts: dict[int, Counter[str]] = defaultdict(Counter)
    took: dict[int, list[float]] = defaultdict(list)
    for n in range(asked.n):
        spare, (task, pose, goal, shut) = n % SPARE, the(n, asked.seed)
        shield = make_shield([synthesise(task)])
        accepted, began = True, time.perf_counter()
        try:
            start(shield, pose.tolist())
        except InfeasibleStart:
            accepted = False
        took[spare].append(1e3 * (time.perf_counter() - began))
        counts[spare] += Counter(starts=1, accepted=int(accepted))
        if not accepted:
            print(
                f"missed {n}: {task.formula} {task.regions} from {pose.tolist()}, {spare} to spare",
                flush=True,
            )
        if accepted and asked.episodes:
            kept = keeps(shield, pose, goal, shut, np.random.default_rng([asked.seed, n, 1]))
            counts[spare] += Counter(episodes=1, kept=int(kept))
            if not kept:
                print(f"broken {n}: {task.formula} {task.regions} from {pose.tolist()}", flush=True)
    print("| steps to spare | starts | accepted | share | episodes | kept | start [ms]: median / most |")
    print("|---" * 7 + "|")
    counts[SPARE] = sum(counts.values(), Counter[str]())
    took[SPARE] = [ms for each in took.values() for ms in each]
    for spare, found in sorted(counts.items()):
        times = took[spare]
        low, high = clopper_pearson(found["accepted"], found["starts"])
        share = found["accepted"] / max(found["starts"], 1)
        print(
            f"| {spare if spare < SPARE else 'all'} | {found['starts']} | {found['accepted']} "
            f"| {share:.3f} [{low:.3f}, {high:.3f}] | {found['episodes']} | {found['kept']} "
            f"| {np.median(times):.0f} / {max(times):.0f} |"
        )


if __name__ == "__main__":
    main()
