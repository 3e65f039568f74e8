"""Whether refusals are true: no rule is called impossible that a search of another kind finds a way for.

    python -m benchmarks.refusals [--rules 500] [--seed 0]

Random rules from random starts in the cases' apartments, with windows that end about when a way can be there:
the search says by when a place can be reached, and the window ends up to 10 steps before that or 4 after it.
Each rule is then asked for its proof that no future exists (reasons/bound.py), and searched. The search
(ways.py) shares nothing with the proof but f.

Prints Markdown: how many rules were proved impossible, for how many of those a way was found (it has to be
none), and of those for which no way was found, how many are proved. The same of `late_by` of single
conjuncts: how often the search knows an earlier end than the one that is named.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace

import numpy as np

from benchmarks.ways import Floats, Part, earliest, rule
from specshield.episode import make_shield
from specshield.policy.dqn.environment import free_poses
from specshield.reasons.bound import proof
from specshield.reasons.relaxation import relaxations
from specshield.robot import STRETCH
from specshield.robot.dynamics import Body, make_body
from specshield.shield.proposal import Proposal
from specshield.sim.cases import case_names, load_case
from specshield.task import Task, make_task


class Still:
    """A policy that stands: every rule that asks for anything is refused."""

    id = "still"

    def __init__(self, task: Task) -> None:
        self.task = task

    def propose(self, history: Floats, signals: object, margin: float) -> Proposal:
        wait, steps = self.task.robot.wait_motion, self.task.horizon + 1 - len(history)
        return Proposal(np.full((1, steps), wait), wait)


def draw(case: str, body: Body, random: np.random.Generator) -> tuple[list[Part], Floats]:
    """A rule whose windows end about when a way can be there."""
    task = load_case(case).task
    poses = free_poses(task, body, 4, random)
    goals, parts, at = int(random.integers(1, 4)), list[Part](), 0
    if random.random() < 0.5:
        x, y, _ = poses[3].tolist()
        parts.append(Part("out", (x, y, float(random.uniform(0.3, 0.9))), int(random.integers(0, 3)), 60))
    for goal in range(min(goals, 2)):
        x, y, _ = poses[1 + goal].tolist()
        disc = (x, y, float(random.uniform(0.15, 0.5)))
        part = Part("reach", disc, at, 300, int(random.choice([0, 0, 3])))
        by = earliest(body, STRETCH.wait_motion, poses[:1], [*parts, part], 60)
        if by < 0:
            by = int(random.integers(5, 60))
        end = max(at, by - part.dwell + int(random.integers(-10, 5)))
        parts.append(replace(part, a=int(random.integers(0, at + 1)), b=end))
        at = int(random.choice([0, end + 1]))
    return parts, poses[0]


def main() -> None:
    parser = argparse.ArgumentParser(description="Whether refusals are true, as Markdown.")
    parser.add_argument("--rules", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    random = np.random.default_rng(asked.seed)
    counts, cost, gaps = Counter[str](), list[float](), Counter[int]()
    names = case_names()
    bodies = {name: make_body(STRETCH, load_case(name).task.grid) for name in names}
    while counts["rules"] < asked.rules:
        case = names[counts["rules"] % len(names)]
        parts, pose = draw(case, bodies[case], random)
        task = make_task(load_case(case).task.grid, STRETCH, *rule(parts))
        counts["rules"] += 1
        began = time.perf_counter()
        why = proof(task, bodies[case], pose[None], {})
        cost.append(time.perf_counter() - began)
        way = earliest(bodies[case], STRETCH.wait_motion, pose[None], parts, task.horizon) >= 0
        counts["proved"] += why is not None
        counts["false"] += why is not None and way
        counts["none found"] += not way
        if why is not None and way:
            print(f"FALSE: {case} {task.formula} from {pose.tolist()}: {why}", flush=True)
        if counts["rules"] % 10 == 0 and not way:
            _tightness(task, bodies[case], pose, parts, gaps)
    print("| seed | rules | proved | of these a way found | no way found | of these proved | p50, max [ms] |")
    print("|---" * 7 + "|")
    share = counts["proved"] / max(counts["none found"], 1)
    p50, most = 1e3 * np.percentile(cost, 50), 1e3 * max(cost)
    print(
        f"| {asked.seed} | {counts['rules']} | {counts['proved']} | {counts['false']} "
        f"| {counts['none found']} | {share:.3f} | {p50:.0f}, {most:.0f} |"
    )
    print(f"\nlate_by of {gaps.total()} conjuncts alone, minus the search's: {dict(sorted(gaps.items()))}")


def _tightness(task: Task, body: Body, pose: Floats, parts: list[Part], gaps: Counter[int]) -> None:
    relaxed = relaxations(make_shield([Still(task)]), pose[None], {})
    for part, told in zip(parts, relaxed.conjuncts, strict=True):
        if part.is_goal and not told.feasible_alone and told.late is not None:
            by = earliest(body, STRETCH.wait_motion, pose[None], [part.later(200)], part.b + 200)
            gaps[told.late.steps - (by - part.dwell - part.b)] += 1


if __name__ == "__main__":
    main()
