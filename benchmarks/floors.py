"""Large floors: what reachability's tables cost there, by the rule's horizon.

    python -m benchmarks.floors [--sides 60x45 120x90] [--starts 100]

An office floor of two rows of rooms along each corridor, with desks, cells of 0.05 m. Processor time is all
threads' together; the machine's own load does not count in it. Of the starts that an exact search (exact.py)
finds feasible for a near deadline, those are counted that are accepted. Prints Markdown.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from benchmarks.exact import NOWHERE, Goal, fewest_steps
from specshield.episode import make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.policy.reachability.policy import synthesise
from specshield.robot import STRETCH
from specshield.robot.dynamics import make_body
from specshield.task import Task, make_task
from specshield.world.occupancy import OccupancyGrid

RESOLUTION = 0.05
ROOM, CORRIDOR = (4.0, 3.75), 1.8  # [m]
DEADLINE = 60  # [steps] of the rule whose starts are searched
POSES = 8_000_000  # of one search
RULES = (
    "F[0,60] A and G[0,60] not C",
    "F[0,200] A and G[0,200] not C",
    "F[0,100] A and F[100,200] B and G[0,200] not C",
)


def office(width: float, height: float) -> OccupancyGrid:
    random = np.random.default_rng(0)
    occupied = np.zeros((round(height / RESOLUTION), round(width / RESOLUTION)), bool)

    def fill(x0: float, y0: float, x1: float, y1: float, value: bool = True) -> None:
        columns, rows = (
            slice(max(round(a / RESOLUTION), 0), round(b / RESOLUTION)) for a, b in ((x0, x1), (y0, y1))
        )
        occupied[rows, columns] = value

    for y in np.arange(0.0, height, 2 * ROOM[1] + CORRIDOR):
        for wall in (y, y + ROOM[1], y + 2 * ROOM[1]):
            fill(0.0, wall - 0.06, width, wall + 0.06)
        for x in np.arange(0.0, width, ROOM[0]):
            fill(x - 0.06, y, x + 0.06, y + 2 * ROOM[1])
            for wall in (y + 2 * ROOM[1], y):
                door = x + random.uniform(1.0, 2.5)
                fill(door, wall - 0.1, door + 1.0, wall + 0.1, False)
            for _ in range(3):
                fx, fy = (
                    x + random.uniform(0.2, 3.0),
                    y + random.choice([0.3, 4.1]) + random.uniform(0.0, 2.4),
                )
                fill(fx, fy, fx + random.uniform(0.4, 1.2), fy + random.uniform(0.4, 0.8))
    for x in np.arange(14.0, width - 2.0, 19.0):  # corridors across
        fill(x, 0.2, x + 2.0, height - 0.2, False)
    for edge in ((0, 0, width, 0.15), (0, height - 0.15, width, height), (0, 0, 0.15, height)):
        fill(*edge)
    fill(width - 0.15, 0, width, height)
    return OccupancyGrid(occupied, RESOLUTION)


def task_on(grid: OccupancyGrid, rule: str) -> Task:
    regions = {
        "A": {"type": "circle", "center": [15.0, 20.5], "radius": 0.8},
        "B": {"type": "circle", "center": [34.0, 8.6], "radius": 0.8},
        "C": {"type": "rectangle", "min": [20.0, 25.0], "max": [24.0, 30.0]},
    }
    return make_task(grid, STRETCH, rule, regions)


def found(grid: OccupancyGrid, count: int) -> tuple[int, int, int, int]:
    """Starts that the search finds feasible, those of them that are accepted, and the same with at most 3
    steps to spare.
    """
    task = task_on(grid, f"F[0,{DEADLINE}] A")
    shield, body = make_shield([synthesise(task)]), make_body(STRETCH, grid)
    goal, random = Goal(x=15.0, y=20.5, radius=0.8), np.random.default_rng(3)
    result, tried = np.zeros(4, int), 0
    while tried < count:
        pose = free_poses(task, body, 1, random)[0]
        if not 4.0 < np.hypot(pose[0] - goal.x, pose[1] - goal.y) < 0.2 * DEADLINE:
            continue
        tried += 1
        least = fewest_steps(body, goal, *map(float, pose), DEADLINE, POSES, NOWHERE)
        if least < 0:
            continue
        accepted = True
        try:
            start(shield, pose.tolist())
        except InfeasibleStart:
            accepted = False
        tight = least > DEADLINE - 4
        result += [1, accepted, tight, tight and accepted]
    return tuple(result.tolist())


def main() -> None:
    parser = argparse.ArgumentParser(description="What tables cost on large floors.")
    parser.add_argument("--sides", nargs="+", default=["60x45", "120x90"])
    parser.add_argument("--starts", type=int, default=100)
    asked = parser.parse_args()
    synthesise(task_on(office(12.0, 9.0), RULES[-1]))  # compiles, or loads what is compiled
    print(
        "| floor [m] | rule | pitch [m] | processor time [s] | wall [s] | tables [MB] |\n" + "|---" * 6 + "|"
    )
    for side in asked.sides:
        grid = office(*map(float, side.split("x")))
        for rule in RULES:
            began, worked = time.perf_counter(), time.process_time()
            policy = synthesise(task_on(grid, rule))
            worked, took = time.process_time() - worked, time.perf_counter() - began
            size = policy.card["metrics"]["size_bytes"] / 1e6
            print(
                f"| {side} | {rule} | {policy.tables.pitch:g} | {worked:.1f} | {took:.1f} | {size:.1f} |",
                flush=True,
            )
        if asked.starts:
            feasible, accepted, tight, of_these = found(grid, asked.starts)
            print(
                f"\n{side}: {accepted} of {feasible} accepted; 0 to 3 steps to spare: {of_these} of {tight}\n"
            )


if __name__ == "__main__":
    main()
