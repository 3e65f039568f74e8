"""Forbidden actions and refusals, drawn at random: what is said of them, and what a search says.

    python -m benchmarks.explained [--n 20] [--seed 0]

Random rules in random apartments, with windows that end about when a way can be there. Three in four are
accepted and driven by a model that is noise until some action is forbidden; one in four is refused. Each is
printed with the rule, what was asked, the line that a person reads, and what benchmarks/ways.py says, which
shares nothing with the shield but f: whether there is a way that keeps the rule, and of each conjunct whether
it can be kept alone, and beside the others if its window ended (of `G[a,b] place`: began) later.

Markdown for a reader, who is to judge of each whether it is true and understood. At the end is counted what
can be without one: how often a way is there and whether the line says so, how often the search knows a way
that is less late than the one that is named; and of all forbidden actions of these episodes, how often a way
is known that the policies did not find.
"""

from __future__ import annotations

import argparse
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.ways import CELL, Disc, Part, earliest, rule
from evaluation.model.floor_plans import random_house
from specshield.client.models import Decision
from specshield.errors import InfeasibleStart
from specshield.local.shield import LocalShield
from specshield.policy.dqn.environment import free_poses
from specshield.robot import STRETCH
from specshield.robot.dynamics import Body, make_body, step
from specshield.task import make_task

Floats = NDArray[np.float64]
Random = np.random.Generator
LONGEST, AFTER = 60, 40  # [steps] that a way takes, and by which it may be late
HOUSES = 4  # drawn rules in each house
FORWARD = int(STRETCH.action_names.index("m"))
METHODS = ("reachability", "planner")
KINDS = ("reach", "until", "stay", "out", "dwell")
UNCERTAINTIES = ("none", "learned")
SEARCHED = """The search takes poses that are nearly the same for one. Where it finds a way, there is one;
where it finds none, or names the steps that a window would have to end later, there may be a better one."""
FINE = CELL / 2.0  # [m]
KNOWN = "a way is known"  # as the line says it


@dataclass(frozen=True)
class Case:
    """A rule from a pose, and the shield that keeps it."""

    number: int
    body: Body
    shield: LocalShield
    parts: tuple[Part, ...]
    pose: Floats
    uncertainty: str

    def way(self, history: Floats, parts: Sequence[Part] | None = None, cell: float = CELL) -> bool:
        parts = self.parts if parts is None else parts
        until = max([len(history) - 1, *(part.b + part.dwell for part in parts)])
        return earliest(self.body, STRETCH.wait_motion, history, parts, until, cell) >= 0


def drawn(number: int, seed: int, spare: tuple[int, int]) -> Case:
    """spare: the least and the most [steps] by which a window ends after what the search needs."""
    random = np.random.default_rng([seed, number])
    grid = random_house(np.random.default_rng([seed, number // HOUSES, 1])).grid
    body = make_body(STRETCH, grid)
    while True:
        poses = free_poses(make_task(grid, STRETCH, "F[0,1] x > 0"), body, 6, random)
        parts = _parts(body, poses, spare, random)
        if parts:
            break
    formula, regions = rule(parts)
    plans = any(part.kind == "until" for part in parts) or random.random() < 0.5
    shield = LocalShield.make(grid, formula, regions, method=METHODS[int(plans)])
    return Case(number, body, shield, parts, poses[0], UNCERTAINTIES[number % 2])


def _parts(body: Body, poses: Floats, spare: tuple[int, int], random: Random) -> tuple[Part, ...]:
    """One or two goals, and often a place to keep out of; none where the search cannot meet them."""
    start, parts, at = poses[:1], list[Part](), 0
    kinds = random.choice(KINDS[:3] + KINDS[4:], int(random.integers(1, 3)), replace=False)
    if random.random() < 0.5:
        parts.append(Part("out", _disc(poses[5], 0.3, 0.9, random), int(random.integers(0, 3)), LONGEST))
    order = ("reach", "until", "dwell", "stay").index
    for kind, pose in zip(sorted(kinds, key=order), poses[1:], strict=False):
        if at and kind == "until":
            continue
        disc, dwell = _disc(pose, 0.15, 0.5, random), int(random.integers(2, 6)) if kind == "dwell" else 0
        left = None
        if kind == "until":
            between = start[0] + random.uniform(0.3, 0.7) * (pose - start[0])
            left = _disc(between, 0.2, 0.8, random)
            apart = math.dist(left[:2], disc[:2]) > left[2] + disc[2]
            if not apart or math.dist(left[:2], start[0, :2]) <= left[2]:
                return ()
        goal = Part("until" if kind == "until" else "reach", disc, at, LONGEST + AFTER, dwell, left)
        by = earliest(body, STRETCH.wait_motion, start, [*parts, goal], LONGEST)
        if by < 5:
            return ()
        end = max(at, by - dwell + int(random.integers(spare[0], spare[1] + 1)))
        if kind == "stay":
            parts.append(Part("stay", disc, end, end + int(random.integers(3, 15))))
        else:
            parts.append(replace(goal, a=int(random.integers(0, at + 1)) if at else 0, b=end))
            at = int(random.choice([0, end + 1]))
    return tuple(parts)


def _disc(pose: Floats, least: float, most: float, random: Random) -> Disc:
    return round(float(pose[0]), 2), round(float(pose[1]), 2), round(random.uniform(least, most), 2)


def _driven(case: Case, seed: int) -> tuple[list[Decision], list[Floats]]:
    """The decisions of an episode, each explained, and the poses at which they were made."""
    random = np.random.default_rng([seed, case.number, 2])
    pose, decisions, poses = case.pose, list[Decision](), list[Floats]()
    session = case.shield.session(initial_pose=tuple(pose.tolist()), uncertainty=case.uncertainty, seed=seed)
    with session:
        while session.t < case.shield.task.horizon and session.spec_status == "pending":
            logits = np.where(STRETCH.terminal, -np.inf, random.normal(0.0, 2.0, len(STRETCH.actions)))
            logits[FORWARD] += 2.0
            decisions.append(session.step(pose, logits, explain=True))
            poses.append(pose)
            pose = np.array(decisions[-1].next_poses[decisions[-1].execute])
    return decisions, poses


def forbidden(case: Case, seed: int, counts: Counter[str]) -> None:
    """Prints one forbidden action of an episode, drawn at random, if there is one."""
    random = np.random.default_rng([seed, case.number, 3])
    decisions, poses = _driven(case, seed)
    choices = [
        (t, int(action), told)
        for t, decision in enumerate(decisions)
        for action in STRETCH.representative
        if (told := (decision.explanations or ())[action]) is not None and decision.mode != "violated"
    ]
    if not choices:
        return
    counts[f"forbidden in all episodes, {case.uncertainty}"] += len(choices)
    for _, _, told in choices:
        counts[f"of these a way is known, {case.uncertainty}"] += KNOWN in (told.detail or "")
    t, action, told = choices[random.integers(len(choices))]
    decision, x_t = decisions[t], poses[t]
    x, y, theta = x_t.tolist()
    x_next = np.array(step(case.body, x, y, theta, int(STRETCH.motion_of[action])))
    history = np.array([*poses[: t + 1], x_next])
    _heading(case, f"forbidden at step {t}")
    print(f"- asked: '{STRETCH.action_names[action]}' at {_shown(x_t)}, which leads to {_shown(x_next)}")
    if decision.margin or decision.slack:
        print(f"- in hand: {decision.margin:.3g} m, {decision.slack} steps")
    print(f"- **told: {decision.why(action)}**")
    way = _searched(case, history)
    counts["forbidden"] += 1
    counts["a way is there"] += way
    if way and not told.is_kept:
        counts["a way is there, and the line does not say so"] += 1
        print("- THE LINE DOES NOT SAY THAT A WAY IS THERE")
    _late(case, history, told.conjunct, told.late_by, way, counts)


def refused(case: Case, counts: Counter[str]) -> None:
    """Prints what a refusal says, where the start is refused."""
    try:
        case.shield.session(initial_pose=tuple(case.pose.tolist()), uncertainty=case.uncertainty)
    except InfeasibleStart as error:
        _heading(case, "refused")
        print(f"- asked: a session from {_shown(case.pose)}")
        print(f"- **told: {error.message}** ({'' if error.details['proved'] else 'not '}proved)")
        way = _searched(case, case.pose[None])
        counts["refused"] += 1
        counts["a way is there"] += way
        if way and "a search found one" not in error.message:
            counts["a way is there, and the line does not say so"] += 1
            print("- THE LINE DOES NOT SAY THAT A WAY IS THERE")


def _heading(case: Case, what: str) -> None:
    task, method = case.shield.task, case.shield.card["method"]
    formula, regions = rule(case.parts)
    print(f"\n### {case.number}: {what}\n")
    print(f"- rule: `{formula}`")
    for name, region in regions.items():
        print(f"  - {name}: {region['radius']} m around {tuple(region['center'])}")
    floor = f"{task.grid.width * task.grid.resolution:g} x {task.grid.height * task.grid.resolution:g} m"
    print(f"- apartment of {floor}, {method}, uncertainty {case.uncertainty}")


def _searched(case: Case, history: Floats) -> bool:
    """Prints what the search says of the rule and of its conjuncts; whether it finds a way."""
    way = case.way(history)
    print(f"- search: {'there is a way that keeps the rule' if way else 'no way found'}")
    if way:
        return True
    for i, part in enumerate(case.parts):
        others = case.parts[:i] + case.parts[i + 1 :]
        said = ["can" if case.way(history, [part]) else "cannot", "be kept alone"]
        if others:
            said += ["and the others", "can" if case.way(history, others) else "cannot", "without it"]
        late = fewest_later(case, history, i)
        if late is not None:
            does = "began" if part.kind == "stay" else "ended"
            said.append(f"; all can if its window {does} {late} steps later")
        print(f"  - `{_text(case, i)}` {' '.join(said)}")
    return False


def fewest_later(case: Case, history: Floats, i: int) -> int | None:
    """The fewest steps later that the window of part i would have to end, or begin, for a way to be found."""
    part = case.parts[i]
    if part.kind == "out":
        return None

    def enough(late: int, cell: float = CELL) -> bool:
        return case.way(history, [*case.parts[:i], part.later(late), *case.parts[i + 1 :]], cell)

    low, high = 0, min(AFTER, part.b - part.a) if part.kind == "stay" else AFTER
    if not enough(high):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    while high > 1 and enough(high - 1, FINE):  # what the coarse search missed
        high -= 1
    return high


def _late(
    case: Case, history: Floats, conjunct: str, late: int | None, way: bool, counts: Counter[str]
) -> None:
    plain = re.sub(r"[()]", "", conjunct)
    found = [i for i in range(len(case.parts)) if re.sub(r"[()]", "", _text(case, i)) == plain]
    if late is None or way or not found:
        return
    least = fewest_later(case, history, found[0])
    counts["late_by named"] += 1
    if least is not None and least < late:
        counts["late_by: the search knows a sooner way"] += 1
        print(f"- THE SEARCH KNOWS A WAY THAT IS {late - least} STEPS SOONER")


def _text(case: Case, i: int) -> str:
    return rule(case.parts)[0].split(" and ")[i]


def _shown(pose: Floats) -> str:
    return f"({pose[0]:.2f}, {pose[1]:.2f}, {math.degrees(pose[2]):.0f} degrees)"


def main() -> None:
    parser = argparse.ArgumentParser(description="Explanations and refusals, for a reader to judge.")
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    counts, number = Counter[str](), 0
    print(f"# {asked.n} forbidden actions and refusals, seed {asked.seed}")
    print(f"\n{SEARCHED}")
    while counts["forbidden"] + counts["refused"] < asked.n:
        if (counts["forbidden"] + counts["refused"]) % 4 == 3:
            refused(drawn(number, asked.seed, (-8, -1)), counts)
        else:
            case = drawn(number, asked.seed, (0, 12))
            try:
                forbidden(case, asked.seed, counts)
            except InfeasibleStart:
                counts["refused, though the search finds a way"] += case.way(case.pose[None])
        number += 1
    print("\n| what | count |\n|---|--:|")
    for what, count in counts.items():
        print(f"| {what} | {count} |")


if __name__ == "__main__":
    main()
