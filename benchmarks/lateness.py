"""By how many steps noise makes a robot late that follows the certified continuation.

    python -m benchmarks.lateness [--runs 96] [--seed 0]

A Stretch drives to a place of its own in the maps of cases 1 and 2, from anywhere, as the shield's
continuation leads it. Each motion ends off by sigma 1 cm along x and along y and by sigma half a degree, or
closer where that would be inside an obstacle. Nothing is asked beyond the rule. Printed: how often the robot
comes more than k steps later than the first continuation would have; and what V of a threshold over the
episode expects (caution/threshold.py): a normal deviate, rounded to whole steps, and now and then a
longer delay.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
from numpy.typing import NDArray

from specshield.caution.noise import Noise, above, spread_of
from specshield.caution.threshold import FOR, HELD_UP
from specshield.episode import Config, Shield, decide, make_shield, start
from specshield.errors import SpecshieldError
from specshield.policy.reachability.policy import synthesise
from specshield.robot import STRETCH
from specshield.robot.dynamics import Body, in_collision, make_body, successors, wrap
from specshield.sim.cases import load_case
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid

Floats = NDArray[np.float64]
MOVE, TURN = 0.01, math.radians(0.5)  # [m], [rad] standard deviations
STEPS, RADIUS, STARTS = 120, 0.4, 8  # steps of the rule; [m] of the place; starts for each place
SHOWN = (0, 1, 2, 3, 4, 6, 8, 10, 15)  # [steps]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=96)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    print("| case | runs | steps | " + " | ".join(f"> {k}" for k in SHOWN) + " |")
    print("|---|--:|--:|" + "--:|" * len(SHOWN))
    spread = spread_of(Noise(MOVE, TURN, 0.0, 0.0, 1.0), max(abs(far) for far, _ in STRETCH.motions))
    for name in ("case1", "case2"):
        random = np.random.default_rng(asked.seed)
        grid = load_case(name).task.grid
        late, first = drive(grid, asked.runs, random)
        shares = [float((late > k).mean()) for k in SHOWN]
        print(
            f"| {name} | {len(late)} | {first.mean():.0f} | " + " | ".join(f"{p:.3f}" for p in shares) + " |"
        )
        expected = [np.mean([later(spread, int(n), k) for n in first]) for k in SHOWN]
        print("| what V expects | | | " + " | ".join(f"{p:.3f}" for p in expected) + " |")


def later(spread: float, left: int, k: int) -> float:
    """The probability that the robot comes more than k steps late, `left` steps away."""
    held_up = HELD_UP * spread * left * math.exp(-k / FOR)
    return 1.0 - (1.0 - above(k + 0.5, spread * math.sqrt(left))) * math.exp(-held_up)


def drive(grid: OccupancyGrid, runs: int, random: np.random.Generator) -> tuple[Floats, Floats]:
    """By how many steps each run came late, and how many the first continuation needed."""
    body, late, first = make_body(STRETCH, grid), list[int](), list[int]()
    while len(late) < runs:
        place = free_pose(body, grid, random)[:2]
        region = {"A": {"type": "circle", "center": place.tolist(), "radius": RADIUS}}
        task = make_task(grid, STRETCH, f"F[0,{STEPS}] A", region)
        shield = make_shield([synthesise(task)], Config(uncertainty=None, learn_map=False))
        for _ in range(min(STARTS, runs - len(late))):
            needed, taken = run(shield, body, grid, place, random)
            late.append(taken - needed)
            first.append(needed)
    return np.array(late, np.float64), np.array(first, np.float64)


def run(
    shield: Shield, body: Body, grid: OccupancyGrid, place: Floats, random: np.random.Generator
) -> tuple[int, int]:
    """The steps that the first continuation needs to the place, and those that the robot took."""
    while True:
        pose = free_pose(body, grid, random)
        try:
            start(shield, pose.tolist())
        except SpecshieldError:
            continue
        break
    poses, carry, needed = [pose], None, 0
    for t in range(STEPS):
        decision = decide(shield, np.array(poses), None, True, carry=carry)
        if decision.spec_status != "pending":
            return needed, t
        assert decision.completion_action is not None
        motions = [decision.completion_action, *(decision.witness or ())]
        if t == 0:
            needed = steps_to(place, body, pose, motions)
        poses.append(disturbed(body, poses[-1], decision.next_poses[motions[0]], random))
        carry = decision.carry
    return needed, STEPS


def steps_to(place: Floats, body: Body, pose: Floats, actions: list[int]) -> int:
    nexts = np.empty((len(STRETCH.motions), 3))
    for n, action in enumerate(actions, 1):
        successors(body, pose, nexts)
        pose = nexts[STRETCH.motion_of[action]].copy()
        if math.dist(pose[:2], place) < RADIUS:
            return n
    return 0


def disturbed(body: Body, before: Floats, after: Floats, random: np.random.Generator) -> Floats:
    if np.array_equal(before, after):
        return after
    for share in (1.0, 0.5, 0.0):
        off = share * random.normal(size=3) * (MOVE, MOVE, TURN)
        pose = np.array([after[0] + off[0], after[1] + off[1], wrap(after[2] + off[2])])
        if not in_collision(body, *pose):
            return pose
    return after


def free_pose(body: Body, grid: OccupancyGrid, random: np.random.Generator) -> Floats:
    low, high = np.array(grid.bounds[:2]), np.array(grid.bounds[2:])
    while True:
        pose = np.array([*random.uniform(low, high), random.uniform(-math.pi, math.pi)])
        if not in_collision(body, *pose):
            return pose


if __name__ == "__main__":
    main()
