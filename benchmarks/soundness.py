"""Certified continuations, each simulated and judged again: is one of them not what the shield says it is?

    python -m benchmarks.soundness [--most 100000] [--seed 0]

Episodes in drawn houses (evaluation/model/floor_plans.py) of a model that draws its logits at random, under
rules about narrow places and headings, bodies and keep-outs, `until` near its deadline, and patrols. At every
decision each action that is allowed comes with a witness. Each is driven from the start by dynamics written
anew (plain_world.py), places are measured by geometry written anew (judge.py), and the tests' oracle, which
goes by the definition one step at a time (tests/oracles/brute_stl.py), says whether the rule is kept. Prints
Markdown, one row a kind of rule: how many continuations were unsound, which has to be none.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter, defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks import narrow
from benchmarks.judge import Floats, distance
from benchmarks.plain_world import World
from evaluation.model.floor_plans import random_house
from specshield.episode import Shield, decide, make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.policy.planner import policy as planner
from specshield.policy.reachability import policy as reachability
from specshield.robot import STRETCH
from specshield.robot.dynamics import make_body
from specshield.task import make_task
from tests.oracles.brute_stl import brute_robustness

ROUNDING = 1e-9  # robustness this near to 0 is neither
TRIES = 20  # starts of one rule
Random = np.random.Generator
Regions = dict[str, dict[str, Any]]


def circle(at: Floats, radius: float) -> dict[str, Any]:
    return {"type": "circle", "center": np.round(at[:2], 2).tolist(), "radius": round(radius, 3)}


def rectangle(at: Floats, width: float, height: float) -> dict[str, Any]:
    x, y = np.round(at[:2] - np.array([width, height]) / 2, 2).tolist()
    return {"type": "rectangle", "min": [x, y], "max": [round(x + width, 2), round(y + height, 2)]}


def rule(kind: str, free: Floats, random: Random) -> tuple[str, Regions]:
    """A formula and its regions; free [n, 3]: poses of the house."""
    one, two, three = free[random.choice(len(free), 3, replace=False)]
    by = int(random.integers(40, 101))
    size = random.uniform(0.3, 0.8, 4)
    if kind == "narrow":
        goal = narrow.KINDS[list(narrow.KINDS)[random.integers(len(narrow.KINDS))]](random, one)
        return f"F[0,{by}] {goal.formula()}", {
            "Dock": circle(np.array([goal.x, goal.y]), min(goal.radius, 99.0))
        }
    places = {"A": circle(one, size[0]), "B": circle(two, size[1]), "C": rectangle(three, *size[2:])}
    if kind == "bodies":
        return f"F[0,{by}] inside(A) and G[0,{by}] not touches(C) and F[0,{by}] touches(B)", places
    if kind == "until":
        return f"not C U[0,{by}] A and F[0,{by}] B", places
    if kind == "patrol":
        return f"G[0,{by // 2}] F[0,{by // 2 + 10}] A and G[0,{by}] not C", places
    return f"F[0,{by}] A and F[{by // 2},{by + 20}] G[0,5] B and G[0,{by}] not C", places


METHODS = {
    "narrow": reachability,
    "bodies": reachability,
    "visits": reachability,
    "until": planner,
    "patrol": planner,
}


def begun(shield: Shield, poses: Floats) -> Floats | None:
    """The first of the poses that a session can begin at."""
    for pose in poses:
        try:
            start(shield, pose.tolist())
        except InfeasibleStart:
            continue
        return np.asarray(pose)
    return None


def certified(
    shield: Shield, pose: Floats, random: Random
) -> tuple[list[Floats], list[int], list[tuple[int, list[int]]]]:
    """An episode: its poses, its motions, and each certified continuation as the step that it begins at and
    the motions from there to the horizon.
    """
    poses, motions, found, carry = [pose], list[int](), list[tuple[int, list[int]]](), None
    motion_of = STRETCH.motion_of
    for t in range(shield.task.horizon):
        logits = np.where(STRETCH.terminal, -np.inf, random.normal(0.0, 3.0, len(STRETCH.actions)))
        decision = decide(shield, poses, logits, carry=carry, witnesses=True)
        if decision.spec_status != "pending":
            break
        for action in STRETCH.representative:
            rest = decision.witnesses[action]
            if decision.j_values[action] == 1.0 and rest is not None:
                found.append((t, [int(motion_of[a]) for a in (action, *rest)]))
        poses.append(decision.next_poses[decision.action])
        motions.append(int(motion_of[decision.action]))
        carry = decision.carry
    return poses, motions, found


def driven(world: World, pose: Floats, rows: np.ndarray[Any, Any]) -> Floats:
    """Where motions [N, T] lead from a pose, [N, T + 1, 3]; what several rows begin with is driven once."""
    out = np.empty((len(rows), rows.shape[1] + 1, 3))
    out[:, 0] = pose
    for s in range(rows.shape[1]):
        states = np.column_stack([out[:, s], rows[:, s]])
        _, first, which = np.unique(states, axis=0, return_index=True, return_inverse=True)
        out[:, s + 1] = world.next_poses(out[first, s], rows[first, s])[which.ravel()]
    return out


def samples(names: tuple[str, ...], regions: Mapping[str, Any], poses: Floats) -> dict[str, Floats]:
    """What the formula reads along trajectories [N, T + 1, 3]; of bodies, what has the right sign."""
    found = dict[str, Floats]()
    cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    (ahead, left), centre = STRETCH.offset, poses.copy()
    centre[..., 0] += ahead * cos - left * sin
    centre[..., 1] += ahead * sin + left * cos
    for name in names:
        if name in ("x", "y", "theta"):
            found[name] = poses[..., ("x", "y", "theta").index(name)]
        elif name.startswith("touches("):
            found[name] = distance(regions[name[8:-1]], centre) + STRETCH.radius
        elif name.startswith("inside("):
            found[name] = distance(regions[name[7:-1]], centre) - STRETCH.radius
        else:
            found[name] = distance(regions[name], poses)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--most", type=int, default=100_000, help="continuations")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    least, apart, n, began = np.inf, 0.0, 0, time.perf_counter()
    while sum(each["continuations"] for each in counts.values()) < asked.most:
        kind = list(METHODS)[n % len(METHODS)]
        random = np.random.default_rng([asked.seed, n])
        house = random_house(np.random.default_rng([asked.seed, n // 10, 1]))
        n += 1
        plain = make_task(house.grid, STRETCH, "F[0,1] x > 0")
        free = free_poses(plain, make_body(STRETCH, house.grid), 60, random)
        formula, regions = rule(kind, free, random)
        task = make_task(house.grid, STRETCH, formula, regions)
        shield = make_shield([METHODS[kind].synthesise(task)])
        pose = begun(shield, free[:TRIES])
        if pose is None:
            continue
        poses, motions, found = certified(shield, pose, random)
        if not found:
            continue
        rows = np.array([motions[:t] + rest for t, rest in found])
        led = driven(World(task), pose, rows)
        apart = max(apart, float(np.abs(led[-1, : found[-1][0] + 1] - poses[: found[-1][0] + 1]).max()))
        read = samples(task.formula.names, regions, led)
        rho = np.array(
            [
                brute_robustness(task.formula, {k: v[i].tolist() for k, v in read.items()})
                for i in range(len(rows))
            ]
        )
        least = min(least, float(rho.min()))
        wrong = int((rho <= -ROUNDING).sum())
        counts[kind] += Counter(
            episodes=1, continuations=len(rows), unsound=wrong, rounding=int((np.abs(rho) < ROUNDING).sum())
        )
        if wrong:
            print(f"unsound: {formula} {regions} from {pose.tolist()}, rho {rho.min()}", flush=True)
    print(
        "| rules | episodes | continuations | unsound | robustness of 0 but for rounding |\n"
        + "|---" * 5
        + "|"
    )
    for kind in (*counts, "all"):
        total = counts[kind] if kind != "all" else sum(counts.values(), Counter[str]())
        shown = " | ".join(str(total[key]) for key in ("episodes", "continuations", "unsound", "rounding"))
        print(f"| {kind} | {shown} |")
    print(
        f"\nThe least robustness was {least:.2g}; the two simulations were at most {apart:.1g} apart. "
        f"{time.perf_counter() - began:.0f} s."
    )


if __name__ == "__main__":
    main()
