"""Whether refusals are true: no rule is called impossible that a search of another kind finds a way for.

    python -m benchmarks.refusals [--rules 500] [--seed 0]

Random rules from random starts in the cases' apartments, with windows that end about when a way can be there:
the search says by when a place can be reached, and the window ends up to 10 steps before that or 4 after it.
Each rule is then asked for its proof that no future exists (reasons/bound.py), and searched. The search
shares nothing with the proof but f: it goes breadth first over all places, headings and goals met, in steps
of time, and measures circles itself.

Prints Markdown: how many rules were proved impossible, for how many of those a way was found (it has to be
none), and of those for which no way was found, how many are proved. The same of `late_by` of single
conjuncts: how often the search knows an earlier end than the one that is named.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from specshield.policy.dqn.environment import free_poses
from specshield.reasons.bound import proof
from specshield.reasons.relaxation import relaxations
from specshield.robot import STRETCH
from specshield.robot.dynamics import Body, make_body, step
from specshield.shield.episode import make_shield
from specshield.shield.proposal import Proposal
from specshield.sim.cases import case_names, load_case
from specshield.task import Task, make_task

Floats = NDArray[np.float64]
CELL, HEADINGS = 0.1, 60  # [m] and per turn: what the search takes for one place
MOST = 2_000_000  # states of one search


@dataclass(frozen=True)
class Part:
    """F[a,b] (G[0,stay]) of a circle, or G[a,b] not of one."""

    reach: bool
    circle: tuple[float, float, float]
    a: int
    b: int
    stay: int = 0

    def text(self, name: str) -> str:
        if not self.reach:
            return f"G[{self.a},{self.b}] not {name}"
        return f"F[{self.a},{self.b}] " + (f"G[0,{self.stay}] {name}" if self.stay else name)


def task_of(case: str, parts: list[Part]) -> Task:
    names = "ABCDEF"[: len(parts)]
    regions = {
        name: {"type": "circle", "center": list(part.circle[:2]), "radius": part.circle[2]}
        for name, part in zip(names, parts, strict=True)
    }
    text = " and ".join(part.text(name) for name, part in zip(names, parts, strict=True))
    return make_task(load_case(case).task.grid, STRETCH, text, regions)


def earliest(body: Body, pose: Floats, parts: list[Part], until: int) -> int:
    """The first step at which the search has met all goals, -1 where that is not by `until`."""
    rows = np.array([[*p.circle, p.a, p.b, p.stay] for p in parts if p.reach]).reshape(-1, 6)
    outs = np.array([[*p.circle, p.a, p.b] for p in parts if not p.reach]).reshape(-1, 5)
    height, width = body.occupied.shape
    shape = (
        1 << len(rows),
        int(height * body.resolution / CELL) + 2,
        int(width * body.resolution / CELL) + 2,
    )
    seen = np.zeros((*shape, HEADINGS), np.uint8)
    return int(_search(body, STRETCH.wait_motion, pose, rows, outs, until, seen))


@njit(cache=True)
def _inside(x: float, y: float, row: Floats) -> bool:
    return math.hypot(x - row[0], y - row[1]) < row[2]


@njit(cache=True)
def _allowed(x: float, y: float, t: int, outs: Floats) -> bool:
    for row in outs:
        if row[3] <= t <= row[4] and math.hypot(x - row[0], y - row[1]) >= row[2]:
            continue
        if row[3] <= t <= row[4]:
            return False
    return True


@njit(cache=True)
def _search(body, wait, pose, rows, outs, until, seen):  # type: ignore[no-untyped-def]
    """Breadth first in steps of time. A state that was reached may wait where it is."""
    every = seen.shape[0] - 1
    motions = body.translate.shape[0]
    xs, ys, hs = np.empty(MOST), np.empty(MOST), np.empty(MOST)
    met, ready = np.empty(MOST, np.int64), np.empty(MOST, np.int64)
    xs[0], ys[0], hs[0], met[0], ready[0] = pose[0], pose[1], pose[2], 0, 0
    count, fresh = 1, 0
    alive = np.ones(MOST, np.uint8)
    for t in range(until + 1):
        begin = fresh
        for r in range(outs.shape[0]):  # a place that is free again may be gone through: all look anew
            if t > 0 and t - 1 == outs[r, 4] + 1:
                begin = 0
        if t > 0:
            stop = count
            fresh = stop
            for i in range(begin, stop):
                if not alive[i] or ready[i] > t - 1:
                    continue
                for m in range(motions):
                    if m == wait:
                        continue
                    x, y, h = step(body, xs[i], ys[i], hs[i], m)
                    if not _allowed(x, y, t, outs):
                        continue
                    j, k = int((y - body.origin_y) / CELL), int((x - body.origin_x) / CELL)
                    q = round(h * HEADINGS / (2 * math.pi)) % HEADINGS
                    if j < 0 or k < 0 or j >= seen.shape[1] or k >= seen.shape[2] or seen[met[i], j, k, q]:
                        continue
                    seen[met[i], j, k, q] = 1
                    if count == MOST:
                        return -1
                    xs[count], ys[count], hs[count], met[count], ready[count] = x, y, h, met[i], t
                    count += 1
        i = 0
        while i < count:
            if alive[i] and ready[i] <= t and not _allowed(xs[i], ys[i], t, outs):
                alive[i] = 0
            elif alive[i] and ready[i] <= t:
                for g in range(rows.shape[0]):
                    bit = 1 << g
                    new = ready[i] == t or t == rows[g, 3]
                    if (
                        not (met[i] & bit)
                        and new
                        and rows[g, 3] <= t <= rows[g, 4]
                        and _inside(xs[i], ys[i], rows[g])
                    ):
                        over = t + int(rows[g, 5])
                        fine = over <= until
                        for s in range(t, over + 1):
                            fine = fine and _allowed(xs[i], ys[i], s, outs)
                        if fine and count < MOST:
                            xs[count], ys[count], hs[count] = xs[i], ys[i], hs[i]
                            met[count], ready[count] = met[i] | bit, over
                            count += 1
            if alive[i] and met[i] == every and ready[i] <= t:
                kept = True
                last = 0
                for row in outs:
                    last = max(last, int(row[4]))
                for s in range(t, last + 1):
                    kept = kept and _allowed(xs[i], ys[i], s, outs)
                if kept:
                    return t
            i += 1
    return -1


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
        parts.append(Part(False, (x, y, float(random.uniform(0.3, 0.9))), int(random.integers(0, 3)), 60))
    for goal in range(min(goals, 2)):
        x, y, _ = poses[1 + goal].tolist()
        part = Part(True, (x, y, float(random.uniform(0.15, 0.5))), at, 300, int(random.choice([0, 0, 3])))
        by = earliest(body, poses[0], [*parts, part], 60)
        if by < 0:
            by = int(random.integers(5, 60))
        end = max(at, by - part.stay + int(random.integers(-10, 5)))
        parts.append(Part(True, part.circle, int(random.integers(0, at + 1)), end, part.stay))
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
        task = task_of(case, parts)
        counts["rules"] += 1
        began = time.perf_counter()
        why = proof(task, bodies[case], pose[None], {})
        cost.append(time.perf_counter() - began)
        way = earliest(bodies[case], pose, parts, task.horizon) >= 0
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
        if part.reach and not told.feasible_alone and told.late_by is not None:
            longer = Part(True, part.circle, part.a, part.b + 200, part.stay)
            by = earliest(body, pose, [longer], part.b + 200)
            gaps[told.late_by - (by - part.stay - part.b)] += 1


if __name__ == "__main__":
    main()
