"""Robots whose turns do not divide the circle: how many of the feasible starts are accepted.

    python -m benchmarks.odd_robots [--starts 10] [--seed 5]

Forward by 0.25 m, turns of ten angles, with and without a motion that waits; arcs; 64 motions; in two drawn
houses, with a near deadline and a far one. What is feasible an exact search says (exact.py), which shares no
code with the policies. Prints Markdown, one row for each robot.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.exact import MOST, NOWHERE, Goal, fewest_steps
from evaluation.model.floor_plans import random_house
from evaluation.statistics import clopper_pearson
from specshield.episode import make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.policy.reachability.policy import synthesise
from specshield.robot import Robot, robot_from_json
from specshield.robot.dynamics import make_body
from specshield.task import make_task

TURNS = (0.5236, 0.5, 0.3, 0.7854, 0.4, 0.35, 0.6, 0.25, 0.9, 1.1)  # [rad]
DEADLINES = (40, 100)  # [steps]
WAIT = {"name": "wait"}


def robots() -> Iterator[tuple[str, Robot]]:
    def made(*actions: dict[str, Any]) -> Robot:
        return robot_from_json({"footprint": {"radius": 0.2}, "actions": list(actions)})

    for turn in TURNS:
        moves = ({"name": "forward", "translate": 0.25}, {"name": "left", "rotate": turn})
        right = {"name": "right", "rotate": -turn}
        yield f"{turn} rad", made(*moves, right, WAIT)
        yield f"{turn} rad, no wait", made(*moves, right)
    for name, speeds, turns in (
        ("15 arcs and a wait", (0.1, 0.2, 0.3), (-0.5, -0.2, 0.0, 0.2, 0.5)),
        ("64 motions, no wait", np.linspace(-0.2, 0.3, 8), np.linspace(-0.7, 0.7, 8)),
    ):
        pairs = [(float(v), float(w)) for v in speeds for w in turns]
        arcs = [{"name": f"{v:.2f} {w:.2f}", "translate": v, "rotate": w} for v, w in pairs]
        yield name, made(*arcs, *([WAIT] if "wait" in name and "no wait" not in name else []))


def counted(robot: Robot, starts: int, seed: int) -> tuple[Counter[str], float]:
    """Feasible and accepted starts of one robot, and the largest of its tables [MB]."""
    counts, largest = Counter[str](), 0.0
    for number in range(2):
        house = random_house(np.random.default_rng([77, number]))
        body, random = make_body(robot, house.grid), np.random.default_rng([seed, number])
        *poses, at = free_poses(make_task(house.grid, robot, "F[0,1] x > 0"), body, starts + 1, random)
        goal = Goal(x=round(float(at[0]), 2), y=round(float(at[1]), 2), radius=0.5)
        dock = {"Dock": {"type": "circle", "center": [goal.x, goal.y], "radius": goal.radius}}
        for deadline in DEADLINES:
            policy = synthesise(make_task(house.grid, robot, f"F[0,{deadline}] Dock", dock))
            largest = max(largest, policy.card["metrics"]["size_bytes"] / 1e6)
            shield = make_shield([policy])
            for pose in poses:
                feasible = fewest_steps(body, goal, *map(float, pose), deadline, MOST, NOWHERE) >= 0
                try:
                    start(shield, pose.tolist())
                    counts["accepted"] += feasible
                    counts["beyond"] += not feasible
                except InfeasibleStart:
                    pass
                counts["feasible"] += feasible
    return counts, largest


def main() -> None:
    parser = argparse.ArgumentParser(description="Robots whose turns do not divide the circle.")
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--seed", type=int, default=5)
    asked = parser.parse_args()
    print("| robot | feasible | accepted | accepted beyond the search | tables [MB] |\n" + "|---" * 5 + "|")
    total = Counter[str]()
    for name, robot in robots():
        counts, largest = counted(robot, asked.starts, asked.seed)
        total += counts
        shown = " | ".join(str(counts[key]) for key in ("feasible", "accepted", "beyond"))
        print(f"| {name} | {shown} | {largest:.1f} |", flush=True)
    low, high = clopper_pearson(total["accepted"], total["feasible"])
    print(f"\n{total['accepted']} of {total['feasible']} accepted [{low:.4f}, {high:.4f}]")


if __name__ == "__main__":
    main()
