"""One run in a world that differs from the description: a session that learns, beside an oracle."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from evaluation.disturbance import believed
from evaluation.houses import DRAWN, load_house_case
from evaluation.models import named
from evaluation.worlds.oracle import Make, can_keep
from evaluation.worlds.robots import ROBOTS
from evaluation.worlds.world import STAYS, World, look, make_world
from specshield.episode import Shield, decide, make_shield, start
from specshield.errors import InfeasibleStart, PoseError
from specshield.policy.dqn.environment import free_poses
from specshield.policy.reachability.policy import synthesise
from specshield.robot.dynamics import in_collision, simulate
from specshield.service.warmup import PARTS, warm_up
from specshield.shield.decision import Carry, Config
from specshield.shield.uncertainty import Uncertainty
from specshield.sim.cases import Case, load_case
from specshield.sim.robot import Pose, SimulatedRobot
from specshield.stl import SATISFIED_ABOVE, conjuncts, robustness

MAX_STEPS = 600
DRAWS = 100  # starts tried for one run before giving up
MODEL, START, WORLD = range(3)  # streams of a run's seed
SENSING = ("scan", "contact", "none")


@dataclass(frozen=True)
class Trial:
    """One run's conditions.

    case: case1, case2, or a house as in evaluation/houses.py. world, sensing: of WORLDS and SENSING.
    uncertain: whether the session learns how exact its robot is, as by default. margin [m], slack [steps]:
    the least that are kept. robot: of ROBOTS. The learned model is the Stretch's; others have the
    goal-seeker.
    """

    case: str
    world: str
    sensing: str
    seed: int = 0
    uncertain: bool = True
    slack: int = 0
    margin: float = 0.0
    robot: str = "stretch"

    @property
    def config(self) -> Config:
        known = Uncertainty() if self.uncertain else None
        return Config(
            slack=self.slack, margin=self.margin, uncertainty=known, learn_map=self.sensing != "none"
        )


@dataclass(frozen=True)
class Outcome:
    """What came of it. could: whether the oracle, told the true world, finds a way at the start."""

    run: int
    could: bool
    kept: bool
    rho: float
    kl: float
    broken: list[str]
    modes: dict[str, int]
    changed: int
    p50_ms: float
    p99_ms: float
    changed_ms: list[float]
    poses: list[list[float]]

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def known(case: str) -> Case:
    """A case by its name, or a house as in evaluation/houses.py. Raises NotFound where there is none."""
    house = DRAWN.fullmatch(case) or case.endswith(".json")
    return load_house_case(case) if house else load_case(case)


@lru_cache(maxsize=4)
def prepared(case: str, collider: bool, robot: str) -> tuple[Case, Shield]:
    """A case, and the shield as it is told, with the paper's settings; kernels are loaded, as in a server."""
    for part in PARTS:
        warm_up(part)
    found = known(case)
    found = replace(found, task=replace(found.task, robot=ROBOTS[robot]))
    task = believed("collider" if collider else "none", found.task)
    return found, make_shield([synthesise(task)])


def run(trial: Trial, i: int) -> Outcome:
    """Run i. Its start, model, draws and world follow from the seed and i alone, whatever is sensed."""
    case, plain = prepared(trial.case, trial.world == "collider", trial.robot)
    model = "learned" if trial.robot == "stretch" else "goal-seeker"
    return run_in(trial, i, case, plain, synthesise, model)


def run_in(trial: Trial, i: int, case: Case, plain: Shield, make: Make, model: str) -> Outcome:
    """The same in a case, with a shield as it is told. make: makes the oracle's policies. model: its name."""
    own = int(np.random.SeedSequence([trial.seed, i]).generate_state(1)[0])
    shield = replace(plain, config=replace(trial.config, seed=own))
    world, pose = _begin(trial, case, plain, own)
    could = can_keep(world, pose, make)
    return _drive(trial, i, own, case, shield, world, pose, could, model)


def _begin(trial: Trial, case: Case, shield: Shield, own: int) -> tuple[World, Pose]:
    starts = free_poses(shield.task, shield.body, DRAWS, np.random.default_rng([own, START]))
    for x, y, theta in starts.tolist():
        pose = (x, y, theta)
        try:
            start(shield, pose)
        except (InfeasibleStart, PoseError):
            continue
        random = np.random.default_rng([own, WORLD])
        world = make_world(trial.world, case, partial(certified_way, shield, pose), random)
        if not in_collision(world.case.body, *pose):
            return world, pose
    raise InfeasibleStart(f"none of {DRAWS} starts in {case.name} can satisfy the rule", path="initial_pose")


def certified_way(shield: Shield, pose: Pose) -> np.ndarray:
    """The poses of the continuation that is certified at the start. Shape [T + 1, 3]."""
    decision = decide(shield, [pose], None, main_task_done=True)
    actions = [decision.action, *(decision.witness or ())]
    poses = np.empty((len(actions), 3))
    simulate(shield.body, np.array(pose), shield.task.robot.motion_of[actions], poses)
    return np.concatenate([[pose], poses])


def _drive(
    trial: Trial,
    i: int,
    own: int,
    case: Case,
    shield: Shield,
    world: World,
    pose: Pose,
    could: bool,
    asked: str,
) -> Outcome:
    model = named(asked).make(case)
    robot = SimulatedRobot(world.case, pose)
    terminal = case.task.robot.terminal
    poses = np.empty((MAX_STEPS + 1, 3))
    carry: Carry | None = None
    done, t, leaves = False, 0, -1
    modes: dict[str, int] = {}
    times, changing = list[float](), list[float]()
    model.reset(np.random.default_rng([own, MODEL]))
    changed, kl = 0, 0.0
    while True:
        poses[t] = robot.pose
        if leaves < 0 and world.is_triggered(robot.pose):
            leaves = t + STAYS
            robot = _in(world.busy, robot)
        elif t == leaves:
            robot = _in(world.case, robot)
        if t == MAX_STEPS:
            break
        logits = None if done else model.logits(robot)
        body = robot._case.body
        occupied, free = look(body, robot.pose) if trial.sensing == "scan" else (None, None)
        began = time.perf_counter()
        decision = decide(shield, poses[: t + 1], logits, done, carry=carry, occupied=occupied, free=free)
        seconds = time.perf_counter() - began
        times.append(seconds)
        if decision.map_revision != changed:
            changing.append(seconds)
            changed = decision.map_revision
        carry = decision.carry
        kl += decision.kl or 0.0
        modes[decision.mode] = modes.get(decision.mode, 0) + 1
        if logits is not None and terminal[decision.action]:
            done = True
        execute = decision.completion_action if terminal[decision.action] else decision.action
        if execute is None or (done and decision.spec_status == "satisfied") or t >= case.task.horizon:
            break
        robot.execute(execute)
        t += 1
    states = np.concatenate([poses[: t + 1], np.repeat(poses[t : t + 1], max(case.task.horizon - t, 0), 0)])
    samples = case.task.samples(states)
    kept = {str(part): float(robustness(part, samples)) for part in conjuncts(case.task.formula)}
    rho = min(kept.values())
    return Outcome(
        run=i,
        could=could,
        kept=rho > SATISFIED_ABOVE,
        rho=round(rho, 4),
        kl=round(kl, 4),
        broken=[part for part, value in kept.items() if value <= SATISFIED_ABOVE],
        modes=modes,
        changed=changed,
        p50_ms=round(1e3 * float(np.median(times)), 3),
        p99_ms=round(1e3 * float(np.percentile(times, 99)), 3),
        changed_ms=[round(1e3 * each, 2) for each in changing],
        poses=poses[: t + 1].round(3).tolist(),
    )


def _in(case: Case | None, robot: SimulatedRobot) -> SimulatedRobot:
    """The robot where it is, in another world."""
    assert case is not None
    other = SimulatedRobot(case, robot.pose)
    other.last_action = robot.last_action
    return other
