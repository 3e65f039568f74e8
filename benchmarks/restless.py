"""Robots that cannot stand still: what reachability's tables and the planner find of all that is feasible.

    python -m benchmarks.restless [--worlds 3] [--states 16] [--seed 7]

The small worlds of benchmarks/worlds.py without their motion that waits: with turns on the spot, and with
arcs alone. Recall is the share of the (history, motion) pairs with a future that keeps the rule that a method
certifies, half of them drawn where some motion is not feasible. One row for each kind of world, robot and
shape of rule, in Markdown.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.judge import Judge
from benchmarks.permissiveness import certified
from benchmarks.worlds import DONE, KINDS, SHAPES, Exact, Key, World, explore, make_world
from specshield.policy.planner import policy as planner
from specshield.policy.reachability import policy as reachability
from specshield.robot import Robot
from specshield.robot.dynamics import make_body

METHODS = {"reachability": reachability, "planner": planner}


def robots(robot: Robot) -> dict[str, Robot]:
    """The robot without its wait; and with arcs for its turns."""
    go, left, right, _ = robot.actions
    arcs = tuple(replace(turn, name=f"arc {turn.name}", translate=go.translate) for turn in (left, right))
    return {
        "turns on the spot": replace(robot, name="turns", actions=(go, left, right)),
        "arcs": replace(robot, name="arcs", actions=(go, *arcs)),
    }


def states(exact: Exact, n: int, random: np.random.Generator) -> Iterator[tuple[int, Key]]:
    """x_0, then up to n states (t, key) with something to lose, half where some motion is infeasible."""
    yield 0, next(iter(exact.poses[0]))
    found = [
        (t, key)
        for t, layer in enumerate(exact.after)
        for key in layer
        if exact.good[t][key] and any(done != DONE for done in key[-1])
    ]
    tight = [state for state in found if not exact.feasible(*state).all()]
    for some in (tight, found):
        yield from (some[i] for i in random.permutation(len(some))[: n // 2])


def row(worlds: list[tuple[World, Exact]], n: int, seed: int) -> str:
    """Recall, feasible starts that were found, and the median decision [ms], of each method."""
    pairs = np.zeros(1 + len(METHODS), int)
    starts, unsound = pairs.copy(), 0
    took: dict[str, list[float]] = {name: [] for name in METHODS}
    for number, (world, exact) in enumerate(worlds):
        task, random = world.task, np.random.default_rng([seed, number])
        policies = {
            name: method.synthesise(task, method.Settings(pitch=world.kind.pitch))
            for name, method in METHODS.items()
        }
        body, judge = make_body(task.robot, task.grid), Judge(str(task.formula), world.regions)
        for i, (t, key) in enumerate(states(exact, n, random)):
            history, true = exact.history(t, key), exact.feasible(t, key)
            found = [true]
            for name, policy in policies.items():
                began = time.perf_counter()
                policy.propose(history, {}, 0.0)
                took[name].append(1e3 * (time.perf_counter() - began))
                found.append(certified(policy, body, judge, history))
            unsound += sum(int((claims & ~true).sum()) for claims in found)
            pairs += [int((claims & true).sum()) for claims in found]
            starts += [int(claims.any()) for claims in found] if i == 0 else 0
    recall = " | ".join(f"{share / max(pairs[0], 1):.4f}" for share in pairs[1:])
    medians = " | ".join(f"{np.median(times):.2f}" for times in took.values())
    return f"{pairs[0]} | {recall} | {' / '.join(map(str, starts))} | {medians} | {unsound}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Robots that cannot stand still: tables or planner.")
    parser.add_argument("--worlds", type=int, default=3)
    parser.add_argument("--states", type=int, default=16)
    parser.add_argument("--seed", type=int, default=7)
    asked = parser.parse_args()
    print("| world | robot | formula | feasible pairs | recall: tables | planner ", end="")
    print("| starts: feasible / tables / planner | ms: tables | planner | unsound |\n" + "|---" * 10 + "|")
    for kind in KINDS:
        for which in ("turns on the spot", "arcs"):
            for shape in SHAPES:
                worlds: list[tuple[World, Exact]] = []
                for number in range(20 * asked.worlds):
                    if len(worlds) == asked.worlds:
                        break
                    world = make_world(kind, shape, 1000 * asked.seed + number)
                    robot = robots(world.task.robot)[which]
                    world = replace(world, task=replace(world.task, robot=robot))
                    exact = explore(world)
                    if exact is not None:
                        worlds.append((world, exact))
                print(
                    f"| {kind.name} | {which} | {shape} | {row(worlds, asked.states, asked.seed)} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
