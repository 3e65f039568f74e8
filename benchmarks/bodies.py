"""Case 2b, `G not touches(Forbidden)`: the rule is kept, and the body never in Forbidden, by points of it.

    python -m benchmarks.bodies [--runs 200] [--seed 0]

Episodes of the goal-seeking model behind the shield, from random feasible starts. What is counted shares
nothing with the shield: the footprint is a grid of points every 5 mm with 720 more on its rim, turned with
the robot; none of them may be inside the rectangle at any step of the rule's window. The visits are measured
by the circles themselves. Between two steps the body is looked at in ten places of its straight way or of its
turn: the rule speaks of the steps alone, so what lies between them is printed and not asked for. Prints
Markdown, with 95 % intervals.
"""

from __future__ import annotations

import argparse
from collections import Counter
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from benchmarks.rules import feasible_starts, run
from evaluation.statistics import clopper_pearson
from specshield.episode import Config, make_shield
from specshield.policy.reachability.policy import synthesise
from specshield.robot import STRETCH
from specshield.sim.cases import load_case

Floats = NDArray[np.float64]
SPACING, RIM, BETWEEN = 0.005, 720, 10  # [m] of the points inside; points of the rim; places between steps
VISITS = {"Region1": (0, 50), "Region2": (50, 100), "Region3": (100, 150)}
ALWAYS = (0, 150)


def points() -> Floats:
    """Of the footprint, in the robot's own frame [N, 2]."""
    radius, (ahead, left) = STRETCH.radius, STRETCH.offset
    side = np.arange(-radius, radius + SPACING, SPACING)
    inside = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    around = np.linspace(0.0, 2.0 * np.pi, RIM, endpoint=False)
    rim = radius * np.stack([np.cos(around), np.sin(around)], -1)
    return np.asarray(np.concatenate([inside[np.hypot(*inside.T) <= radius], rim]) + np.array([ahead, left]))


def overlaps(poses: Floats, body: Floats, low: Floats, high: Floats) -> NDArray[np.bool_]:
    """Whether some point of the body is inside the rectangle, at each of poses [n, 3]."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turn = np.array([[cos, -sin], [sin, cos]]).transpose(2, 0, 1)
    at = poses[:, None, :2] + np.einsum("nij,mj->nmi", turn, body)
    return np.asarray(((at > low) & (at < high)).all(axis=2).any(axis=1))


def between(poses: Floats) -> Floats:
    """The poses, and BETWEEN - 1 more from each to the next, the heading by the shorter way."""
    change = np.diff(poses, axis=0)
    change[:, 2] = (change[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    shares = np.arange(BETWEEN)[:, None, None] / BETWEEN
    return np.asarray((poses[:-1] + shares * change).reshape(-1, 3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    case, body = load_case("2b"), points()
    shield = make_shield([synthesise(case.task)], Config(seed=asked.seed))
    regions, refused, counts = case.spec["regions"], list[Floats](), Counter[str]()
    low, high = (np.array(regions["Forbidden"][corner]) for corner in ("min", "max"))
    starts = feasible_starts(shield, np.random.default_rng(asked.seed), refused)
    for i, pose in enumerate(islice(starts, asked.runs)):
        episode = run(shield, case, pose, asked.seed + i)
        poses = np.array(episode.poses)
        met = [
            (np.hypot(*(poses[a : b + 1, :2] - regions[name]["center"]).T) < regions[name]["radius"]).any()
            for name, (a, b) in VISITS.items()
        ]
        window = poses[ALWAYS[0] : ALWAYS[1] + 1]
        inside = overlaps(window, body, low, high)
        counts["satisfied"] += episode.spec_status == "satisfied"
        counts["kept"] += all(met) and not inside.any()
        counts["steps inside"] += int(inside.sum())
        counts["inside between"] += bool(overlaps(between(window), body, low, high).any())
    print(f"{case.task.formula}, {len(body)} points of the body, {len(refused)} starts refused\n")
    print(
        "| runs | satisfied, as the shield says | kept, by points and circles | steps with a point inside |"
    )
    print("|---|---|---|---|")
    low_share, high_share = clopper_pearson(counts["kept"], asked.runs)
    steps, crossed = counts["steps inside"], counts["inside between"]
    print(
        f"| {asked.runs} | {counts['satisfied']} | {counts['kept']} [{low_share:.3f}, {high_share:.3f}] "
        f"| {steps} |\n\nBetween two steps a point was inside in {crossed} runs."
    )


if __name__ == "__main__":
    main()
