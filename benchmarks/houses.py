"""Reachability on real floor plans: a formula of each shape of the fragment, its time, memory and size;
also for a robot that cannot wait.

    python -m benchmarks.houses [FOLDER]

FOLDER holds ProcTHOR houses (houses/) and ROS maps (maps/); by default shared/data beside the repository.
Prints Markdown. Peak memory is the process's, so far.
"""

from __future__ import annotations

import json
import math
import resource
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from specshield.errors import SpecshieldError
from specshield.policy.dqn.environment import free_poses
from specshield.policy.methods import load_policy
from specshield.policy.reachability.policy import synthesise
from specshield.robot import STRETCH, robot_from_json
from specshield.robot.dynamics import make_body
from specshield.task import make_task
from specshield.world.map_server import load_map
from specshield.world.occupancy import OccupancyGrid
from specshield.world.procthor import load_house

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SHAPES = {
    "in turn, G throughout": "F[0,80] A and F[80,160] B and G[0,160] not C",
    "a G that begins late": "F[0,120] A and G[60,160] not C",
    "a G that ends": "F[0,160] A and G[0,60] not C",
    "a dwell": "F[0,60] G[0,10] A",
    "a dwell, then on, G": "F[0,60] G[0,10] A and F[80,160] B and G[0,160] not C",
    "overlapping windows": "F[0,120] A and F[20,140] B and F[40,160] C",
    "one visit for two": "F[0,80] (A or B) and F[80,160] A",
    "disjunctions": "F[0,60] (A or B) and F[80,140] (B or C)",
}
RESTLESS = robot_from_json(
    {
        "footprint": {"radius": STRETCH.radius, "offset": list(STRETCH.offset)},
        "on_contact": "stop",
        "actions": [
            {"name": "forward", "translate": 0.2},
            {"name": "left", "rotate": math.radians(30)},
            {"name": "right", "rotate": -math.radians(30)},
        ],
    }
)
ASKED = [(shape, formula, STRETCH) for shape, formula in SHAPES.items()]
ASKED += [
    (f"{shape}; cannot wait", SHAPES[shape], RESTLESS) for shape in ("in turn, G throughout", "a dwell")
]

World = tuple[str, OccupancyGrid, Mapping[str, Any]]


def worlds(data: Path) -> Iterator[World]:
    """(name, grid, three regions A, B, C): rooms of a house, in a map circles about free poses far apart."""
    sizes = json.loads((data / "houses" / "asset-sizes.json").read_text())
    for path in sorted((data / "houses").glob("house_*.json")):
        grid, rooms = load_house(json.loads(path.read_text()), sizes, 0.05)
        names = [name for name in rooms if f"{name}_1" not in rooms]
        yield path.stem, grid, {letter: rooms[names[i % len(names)]] for i, letter in enumerate("ABC")}
    for path in sorted((data / "maps").glob("*.yaml")):
        grid = load_map(path.read_text(), path.with_suffix(".pgm").read_bytes())
        task = make_task(grid, STRETCH, "F[0,9] x > 0")
        poses = free_poses(task, make_body(STRETCH, grid), 200, np.random.default_rng(0))[:, :2]
        chosen = [poses[0]]
        for _ in range(2):
            gaps = np.min([np.hypot(*(poses - point).T) for point in chosen], axis=0)
            chosen.append(poses[np.argsort(gaps)[len(gaps) // 2]])
        yield (
            path.stem,
            grid,
            {
                letter: {"type": "circle", "center": point.tolist(), "radius": 0.6}
                for letter, point in zip("ABC", chosen, strict=True)
            },
        )


def main() -> None:
    data = Path(sys.argv[1]) if len(sys.argv) > 1 else DATA
    if not (data / "houses" / "asset-sizes.json").is_file():
        sys.exit(
            f"{data} has no houses/asset-sizes.json; evaluation/houses.py says how to get ProcTHOR houses"
        )
    print("| map | size [m] | formula | time [s] | peak memory [MB] | on disk [MB] ", end="")
    print("| loaded [ms] | feasible starts |")
    print("|---|---|---|---|---|---|---|---|")
    for name, grid, regions in worlds(data):
        for shape, formula, robot in ASKED:
            task = make_task(grid, robot, formula, regions=regions)
            size = f"{grid.width * grid.resolution:.1f} x {grid.height * grid.resolution:.1f}"
            began = time.perf_counter()
            try:
                policy = synthesise(task)
            except SpecshieldError as error:
                print(f"| {name} | {size} | {shape} | refused: {error} | | | | |", flush=True)
                continue
            made = time.perf_counter()
            weights = policy.weights()
            read = time.perf_counter()
            load_policy(weights, policy.card, task)
            loaded = time.perf_counter() - read
            print(
                f"| {name} | {size} | {shape} | {made - began:.2f} | {_peak():.0f} "
                f"| {len(weights) / 1e6:.1f} | {1e3 * loaded:.0f} "
                f"| {policy.card['metrics']['feasible_start']:.3f} |",
                flush=True,
            )


def _peak() -> float:
    """The process's largest size so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    main()
