"""Runs on a base that MuJoCo simulates (wheels.py): what its residuals look like, and what is kept.

    python -m evaluation mujoco --case 1 --runs 20 --seed 0

The session has the defaults, and is told what the scanner sees. Its policy is made for the case's map. Starts
are drawn among those from which the rule can be kept in an exact world, so an oracle could keep every run.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from evaluation.houses import load_house_case
from evaluation.models import named
from evaluation.statistics import clopper_pearson
from evaluation.worlds.wheels import WheeledRobot, installed
from specshield.arrays import Floats
from specshield.client.models import Decision
from specshield.errors import InfeasibleStart, PoseError
from specshield.local import LocalSession, LocalShield
from specshield.policy.dqn.environment import free_poses
from specshield.robot.dynamics import wrap
from specshield.sim.cases import Case, case_name, load_case
from specshield.stl import SATISFIED_ABOVE, conjuncts, robustness

DRAWS = 100  # starts tried for one run before giving up
MODEL, START, WHEELS = range(3)  # streams of a run's seed
QUANTILES = (0.5, 0.9, 0.99)


@dataclass
class Outcome:
    """What came of one run. residuals: of each motion its kind, [m] and [rad] from where f has it, and
    whether the base touched something then. margin: the largest that was asked for [m].
    """

    run: int
    kept: bool = False
    broken: list[str] = field(default_factory=list)
    modes: Counter[str] = field(default_factory=Counter)
    residuals: list[tuple[str, float, float, bool]] = field(default_factory=list)
    margin: float = 0.0
    poses: list[tuple[float, float, float]] = field(default_factory=list)


@lru_cache(maxsize=2)
def prepared(name: str) -> tuple[Case, LocalShield]:
    """A case, and a shield for it: case1, case2 or drawn_N, a house of our own drawing."""
    case = load_house_case(name) if name.startswith("drawn") else load_case(name)
    return case, LocalShield.make(
        case.task.grid, case.spec["formula"], case.spec["regions"], rooms=case.rooms
    )


def run(name: str, seed: int, number: int) -> Outcome:
    """Its start, model, draws and wheels follow from the seed and its number alone."""
    own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
    case, shield = prepared(name)
    robot, session = _begun(case, shield, own)
    outcome, model = Outcome(number), named("learned").make(case)
    model.reset(np.random.default_rng([own, MODEL]))
    while not session.finished and session.spec_status == "pending":
        outcome.poses.append(robot.pose)
        occupied, free = robot.look()
        logits = None if session.main_task_done else model.logits(robot)
        decision = session.step(robot.pose, logits, occupied=occupied, free=free)
        outcome.modes[decision.mode] += 1
        outcome.margin = max(outcome.margin, decision.margin)
        if session.spec_status == "pending":
            robot.execute(decision.execute)
            _compare(outcome, case, robot, decision)
    states = np.array(outcome.poses)
    still = np.repeat(states[-1:], max(case.task.horizon + 1 - len(states), 0), axis=0)
    samples = case.task.samples(np.concatenate([states, still]))
    rho = {str(part): float(robustness(part, samples)) for part in conjuncts(case.task.formula)}
    outcome.broken = [part for part, value in rho.items() if value <= SATISFIED_ABOVE]
    outcome.kept = not outcome.broken
    return outcome


def _begun(case: Case, shield: LocalShield, own: int) -> tuple[WheeledRobot, LocalSession]:
    starts = free_poses(case.task, case.body, DRAWS, np.random.default_rng([own, START]))
    for x, y, theta in starts.tolist():
        robot = WheeledRobot(case, (x, y, theta), np.random.default_rng([own, WHEELS]))
        try:
            return robot, shield.session(initial_pose=robot.pose, seed=own)
        except (InfeasibleStart, PoseError):
            continue
    raise InfeasibleStart(f"none of {DRAWS} starts in {case.name} can satisfy the rule", path="initial_pose")


def _compare(outcome: Outcome, case: Case, robot: WheeledRobot, decision: Decision) -> None:
    move, turn = case.task.robot.motions[case.task.robot.motion_of[decision.execute]]
    if not (move or turn):
        return
    kind = "moves" if move else f"turns of {abs(math.degrees(turn)):.0f}°"
    (x, y, theta), (fx, fy, foreseen) = robot.pose, decision.next_poses[decision.execute]
    residual = math.hypot(x - fx, y - fy), abs(wrap(theta - foreseen))
    outcome.residuals.append((kind, *residual, robot.touches))


def report(names: Sequence[str], runs: int, seed: int) -> str:
    """Two tables in Markdown: what was kept, and the residuals of the motions."""
    done = dict[str, list[Outcome]]()
    for name in names:
        done[name] = []
        for number in range(runs):
            done[name].append(run(name, seed, number))
            print(f"{name}: run {number}, {'kept' if done[name][-1].kept else 'BROKEN'}", file=sys.stderr)
    head = f"MuJoCo {installed()}, {runs} runs a case, seed {seed}, all settings by default"
    return "\n".join([head, "", *_kept(done), "", *_residuals(done)])


def _kept(done: dict[str, list[Outcome]]) -> list[str]:
    lines = ["| case | kept | 95 % interval | largest margin | what was broken |"]
    lines.append("|---|--:|--:|--:|---|")
    for name, outcomes in done.items():
        kept, count = sum(each.kept for each in outcomes), len(outcomes)
        low, high = clopper_pearson(kept, count)
        broken = Counter(part for each in outcomes for part in each.broken)
        said = "; ".join(f"{part}: {n}" for part, n in broken.most_common())
        margin = max(each.margin for each in outcomes)
        figures = f"{kept} of {count} | {low:.3f} to {high:.3f} | {100 * margin:.1f} cm"
        lines.append(f"| {name} | {figures} | {said} |")
    return lines


def _residuals(done: dict[str, list[Outcome]]) -> list[str]:
    lines = ["| case | motions | number | [mm] 50, 90, 99 % | [degrees] 50, 90, 99 % |"]
    lines.append("|---|---|--:|---|---|")
    for name, outcomes in done.items():
        seen = [residual for each in outcomes for residual in each.residuals]
        for kind in sorted({kind for kind, *_ in seen}):
            free = np.array([(m, r) for k, m, r, touched in seen if k == kind and not touched])
            lines += _line(name, kind, free)
        lines += _line(name, "any, touching something", np.array([(m, r) for *_, m, r, t in seen if t]))
    return lines


def _line(name: str, kind: str, found: Floats) -> list[str]:
    if not len(found):
        return []
    far, turned = np.quantile(found, QUANTILES, axis=0).T
    millimetres = ", ".join(f"{1e3 * value:.1f}" for value in far)
    degrees = ", ".join(f"{math.degrees(value):.2f}" for value in turned)
    return [f"| {name} | {kind} | {len(found)} | {millimetres} | {degrees} |"]


def named_cases(said: str) -> list[str]:
    """1,2,drawn_3: the cases by their names."""
    return [case_name(each) for each in said.split(",")]
