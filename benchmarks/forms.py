"""Whether noise and slips break rules of every form: with what a session asks for by default, and without.

    python -m benchmarks.forms [--runs 40] [--seed 0]
    python -m benchmarks.forms --worlds [--runs 40] [--seed 0]

The goal-seeking model drives a Stretch in the apartment of case 1, from anywhere that the rule can be kept
from. Slips: one motion in twenty does nothing. Noise: each motion ends off by sigma 1 cm along x and along y
and by sigma half a degree. Printed, for each rule: in how many runs it was kept, and KL a run [nats], by
`uncertainty: "none"` in the exact world and with slips and noise, and by default in the same three.

With --worlds: in worlds that are not as told (evaluation/worlds/world.py), by a scan and by contact alone,
how many runs were kept of those that an oracle can keep, and the time of decisions that changed the map [ms].
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from evaluation import disturbance
from evaluation.experiment import SESSIONS
from evaluation.methods import Method, Shielded
from evaluation.worlds.runs import SENSING, Trial, run_in
from evaluation.worlds.world import WORLDS
from specshield.episode import Config, Shield, make_shield, start
from specshield.errors import SpecshieldError
from specshield.policy.dqn.environment import free_poses
from specshield.policy.methods import DEFAULT
from specshield.policy.planner.policy import synthesise as plan
from specshield.policy.reachability.policy import synthesise as make_tables
from specshield.service.warmup import PARTS, warm_up
from specshield.sim.cases import Case, load_case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import Pose, SimulatedRobot
from specshield.stl import SATISFIED_ABOVE, robustness
from specshield.task import make_task

RULES = (  # what it is, the method, the rule
    ("patrol", "planner", "G[0,90] F[0,60] (Charger1 or Charger2)"),
    ("patrol of one place, keep-out", "planner", "G[20,100] F[0,70] Charger1 and G[0,170] not Kitchen"),
    ("order", "planner", "F[0,70] (Charger1 and F[0,70] Charger2)"),
    ("response", "planner", "F[0,60] Charger1 and G[0,60] (Charger1 -> F[0,50] Charger2)"),
    ("choice", "planner", "F[0,40] Charger1 or F[0,70] (Charger2 and F[0,60] Charger1)"),
    ("until", "planner", "(not Charger2) U[0,80] Charger1"),
    ("meeting", "planner", "G[60,80] Charger1"),
    ("meeting", DEFAULT, "G[60,80] Charger1"),
    ("stay", DEFAULT, "F[0,60] G[0,20] Charger1"),
    ("short window far away", "planner", "F[60,62] G[0,5] Charger1"),
    ("short window far away", DEFAULT, "F[60,62] G[0,5] Charger1"),
    ("patrol, in other words", "planner", "G[0,90] not G[0,60] not (Charger1 or Charger2)"),
    ("condition that a visit ends", "planner", "G[0,70] not Charger1 -> F[0,40] Charger2"),
    ("choice far away", "planner", "F[60,61] Charger1 or F[60,61] Charger2"),
    ("choice of meetings", "planner", "G[60,80] Charger1 or G[60,80] Charger2"),
    ("two things far away", "planner", "F[60,61] (Charger1 and G[0,5] not Kitchen)"),
    ("response far away", "planner", "F[0,60] Charger1 and G[0,60] (Charger1 -> F[50,52] Charger2)"),
)
CONFIGS = {"none": Config(), "default": SESSIONS["default"]}
NOISES = ("none", "slip", "gaussian")
UNTOLD, FELT = WORLDS[1:], SENSING[:2]
START, DRAW, MODEL, MISMATCH = range(4)  # streams of a run's seed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worlds", action="store_true", help="in worlds that are not as told")
    asked = parser.parse_args()
    show = show_worlds if asked.worlds else show_noises
    show(asked.runs, asked.seed)


def show_noises(count: int, seed: int) -> None:
    columns = [f"{config}, {noise}" for config in CONFIGS for noise in NOISES]
    print("| what | rule | method | " + " | ".join(columns) + " |")
    print("|---|---|---|" + "--:|" * len(columns))
    for what, method, rule in RULES:
        case = case_of(rule)
        policy = (plan if method == "planner" else make_tables)(case.task)
        cells = []
        for config in CONFIGS.values():
            shield = make_shield([policy], config)
            for noise in NOISES:
                runs = [run(case, shield, noise, [seed, i]) for i in range(count)]
                cells.append(f"{sum(ok for ok, _ in runs)} ({np.mean([kl for _, kl in runs]):.0f})")
        print(f"| {what} | `{rule}` | {method} | " + " | ".join(cells) + " |", flush=True)


def case_of(rule: str) -> Case:
    base = load_case("case1")
    task = make_task(base.task.grid, base.task.robot, rule, base.spec["regions"], base.rooms)
    return replace(base, task=task)


def show_worlds(runs: int, seed: int) -> None:
    for part in PARTS:  # kernels are loaded, as in a server
        warm_up(part)
    columns = [f"{world}, {sensing}" for world in UNTOLD for sensing in FELT]
    print("| what | rule | method | " + " | ".join(columns) + " | p99 [ms] |")
    print("|---|---|---|" + "--:|" * (len(columns) + 1))
    for what, method, rule in RULES:
        case, make = case_of(rule), plan if method == "planner" else make_tables
        cells, times = list[str](), list[float]()
        for world in UNTOLD:
            shield = make_shield([make(disturbance.believed(world, case.task))])
            for sensing in FELT:
                trial = Trial(rule, world, sensing, seed)
                found = [run_in(trial, i, case, shield, make, "goal-seeker") for i in range(runs)]
                could = [each for each in found if each.could]
                cells.append(f"{sum(each.kept for each in could)} of {len(could)}")
                times += [ms for each in found for ms in each.changed_ms]
        p99 = f"{np.percentile(times, 99):.0f}" if times else ""
        print(f"| {what} | `{rule}` | {method} | " + " | ".join(cells) + f" | {p99} |", flush=True)


def run(case: Case, shield: Shield, noise: str, seed: list[int]) -> tuple[bool, float]:
    """Whether the rule was kept, and the KL of the run [nats]."""
    own = int(np.random.SeedSequence(seed).generate_state(1)[0])
    task, method, model = case.task, Shielded(shield), GoalSeeker(case.task.robot)
    robot = SimulatedRobot(case, a_start(case, shield, own))
    draws, shaken = (np.random.default_rng([own, stream]) for stream in (DRAW, MISMATCH))
    method.begin(own)
    model.reset(np.random.default_rng([own, MODEL]))
    poses, kl = drive(case, method, model, robot, noise, draws, shaken)
    states = np.array(poses + [poses[-1]] * (task.horizon + 1 - len(poses)))
    return bool(robustness(task.formula, task.samples(states)) > SATISFIED_ABOVE), kl


def drive(
    case: Case,
    method: Method,
    model: GoalSeeker,
    robot: SimulatedRobot,
    noise: str,
    draws: np.random.Generator,
    shaken: np.random.Generator,
) -> tuple[list[Pose], float]:
    """The poses to where the rule is decided and the model has ended, or to the horizon."""
    poses, kl, ended = [robot.pose], 0.0, False
    for _ in range(case.task.horizon):
        logits = None if ended else model.logits(robot)
        answer = method.act(np.array(poses), logits, draws.random())
        kl += answer.kl or 0.0
        ended = ended or bool(case.task.robot.terminal[answer.action])
        if answer.execute is None or (ended and answer.spec_status != "pending"):
            break
        before = robot.pose
        robot.execute(answer.execute)
        robot.pose = disturbance.executed(noise, case.body, before, robot.pose, shaken)
        poses.append(robot.pose)
    return poses, kl


def a_start(case: Case, shield: Shield, own: int) -> Pose:
    for x, y, theta in free_poses(case.task, case.body, 500, np.random.default_rng([own, START])).tolist():
        try:
            start(shield, (x, y, theta))
        except SpecshieldError:
            continue
        return x, y, theta
    raise SystemExit(f"no start from which {case.task.formula} can be kept")


if __name__ == "__main__":
    main()
