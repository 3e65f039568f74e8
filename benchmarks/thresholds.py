"""A threshold over the episode: how often it is asked that the rule is kept, and how often it is.

    python -m benchmarks.thresholds [--episodes 2000] [--seed 0]

The episodes are shared out among small worlds of benchmarks/worlds.py from whose start the rule can be kept.
The model nearly always stands still, where that breaks the rule: alone it keeps it in the share shown. Some
worlds leave no time for slips and noise: how often the rule is kept in a world where 1 is asked says what can
be had there. The last three columns are of the worlds in which that is at least what was asked. The verdict
is that of benchmarks/judge.py. The world is exact; or every twentieth motion is not executed, as the session
was told; or motions end off by 0.5 cm and half a degree, as the session was told. The interval is of 99 %, by
Clopper and Pearson.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from benchmarks.judge import Judge
from benchmarks.worlds import KINDS, SHAPES, World, make_world
from specshield.episode import Carry, Config, Shield, decide, make_shield, start
from specshield.errors import InfeasibleStart, PoseError
from specshield.policy.reachability.policy import synthesise
from specshield.robot.dynamics import in_collision, make_body, step
from specshield.shield.uncertainty import Uncertainty

Floats = NDArray[np.float64]
ASKED = (1.0, 0.95, 0.9, 0.8, 0.5)  # 1 first: it says what can be had
STANDS = 4.0  # [nats] by which the model prefers to stand still; beside noise of one nat
WORLDS = 20


@dataclass(frozen=True)
class How:
    """How motions are executed; `told` is what the session is told of it."""

    name: str
    told: Uncertainty | None
    slip: float = 0.0
    move: float = 0.0  # [m] standard deviation
    turn: float = 0.0  # [rad]


HOWS = (
    How("exact", None),
    How("slip 5 %", Uncertainty(0.0, 0.0, 0.05), slip=0.05),
    How("noise", Uncertainty(0.005, math.radians(0.5), 0.0), move=0.005, turn=math.radians(0.5)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--episodes", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    worlds = list(drawn(options.seed))
    each = math.ceil(options.episodes / len(worlds))
    print(
        "| motions | asked | kept | 99 % interval | alone | worlds that can | kept there | 99 % interval |\n"
        "|---|--:|--:|---|--:|--:|--:|---|"
    )
    for how in HOWS:
        alone = sum(kept(world, None, how, 0.0, run) for world, _ in worlds for run in range(each))
        most: Floats | None = None
        for asked in ASKED:
            found = np.array(
                [sum(kept(world, shield, how, asked, run) for run in range(each)) for world, shield in worlds]
            )
            most = found if most is None else most
            can = most >= asked * each
            print(
                f"| {how.name} | {asked} | {share(found, each)} | {alone / each / len(worlds):.3f} "
                f"| {can.sum()} | {share(found[can], each)} |",
                flush=True,
            )


def share(found: NDArray[np.int_], each: int) -> str:
    """The share of what was kept, `found` [worlds] of `each`, and its interval."""
    if not len(found):
        return "- | -"
    n = each * len(found)
    low, high = binomtest(int(found.sum()), n).proportion_ci(0.99, method="exact")
    return f"{found.sum() / n:.3f} | {low:.3f} to {high:.3f}"


def drawn(seed: int) -> Iterator[tuple[World, Shield]]:
    """Worlds in which the rule can be kept, and standing still breaks it."""
    count, number = 0, 1000 * seed
    while count < WORLDS:
        world = make_world(KINDS[count % 2], list(SHAPES)[number % len(SHAPES)], number)
        number += 1
        shield = make_shield([synthesise(world.task)])
        try:
            start(shield, world.start.tolist())
        except (InfeasibleStart, PoseError):
            continue
        still = np.repeat(world.start[None], world.task.horizon + 1, 0)
        if not satisfied(world, still):
            count += 1
            yield world, shield


def kept(world: World, shield: Shield | None, how: How, asked: float, run: int) -> bool:
    """Whether the rule is kept in an episode of the model alone (no shield), or of the shield's answers."""
    task, body = world.task, make_body(world.task.robot, world.task.grid)
    random = np.random.default_rng([run, round(100 * asked)])
    poses = [world.start]
    if shield is not None:
        config = Config(threshold=asked, threshold_over="episode", uncertainty=how.told, seed=run)
        shield = make_shield(shield.proposers, config)
    carry: Carry | None = None
    for _ in range(task.horizon):
        logits = random.normal(0.0, 1.0, 4) + np.array([0.0, 0.0, 0.0, STANDS])
        if shield is None:
            chances = np.exp(logits - logits.max())
            action = int(random.choice(4, p=chances / chances.sum()))
        else:
            found = decide(shield, np.array(poses), logits, carry=carry)
            action, carry = found.action, found.carry
        pose = poses[-1]
        if not random.random() < how.slip:
            x, y, theta = pose
            ahead = np.array(step(body, x, y, theta, action))
            moves = not np.array_equal(ahead, pose)
            off = ahead + moves * random.normal(0.0, 1.0, 3) * (how.move, how.move, how.turn)
            pose = pose if in_collision(body, *off) else off
        poses.append(pose)
    return satisfied(world, np.array(poses))


def satisfied(world: World, poses: Floats) -> bool:
    return bool(Judge(" and ".join(part.text for part in world.parts), world.regions).keeps(poses[None])[0])


if __name__ == "__main__":
    main()
