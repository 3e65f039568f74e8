"""One run of an experiment, by every method asked for.

Run i is decided by the experiment's seed and i alone, whichever process carries it out: its start, the
model's seed, the draws and the disturbance are shared by all methods.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation import conformal, disturbance
from evaluation.experiment import Experiment, Setting
from evaluation.methods import Answer, Method
from evaluation.tasks import MAX_STEPS, is_done
from specshield.episode import Shield, decide, start
from specshield.errors import InfeasibleStart, PoseError
from specshield.policy.dqn.environment import free_poses
from specshield.robot.dynamics import in_collision, simulate, step
from specshield.sim.cases import Case
from specshield.sim.robot import Pose, SimulatedRobot
from specshield.stl import SATISFIED_ABOVE, conjuncts, robustness

Floats = NDArray[np.float64]

DRAWS = 100  # starts tried for one run before giving up
MODEL, DRAW, START, MISMATCH = range(4)  # streams of a run's seed


@dataclass(frozen=True)
class Record:
    """What came of one run by one method.

    seed: of this run. refused: starts drawn before `start` that were infeasible. satisfied, rho: of the
    states x_0 .. x_T, the robot standing still where it stopped earlier [m]. main_done: the model ended
    within 1 m of its target (tasks.py); ended_at: the step of its `end`. broken: the conjuncts that were not
    kept. modes, reasons: how many decisions had each mode and each reason. kl: summed over the
    decisions made for the model, `asked` of them [nats]. residual: the largest surprise of a step
    (conformal.py) [m]. decision_ms: of each decision. mass: pi_FM(S_t) step by step; certified: rho of the
    future that certified what was executed; None where there was none.
    poses: x_0, x_1, ...
    """

    run: int
    method: str
    seed: int
    start: Pose
    refused: int
    satisfied: bool
    rho: float
    main_done: bool
    ended_at: int | None
    broken: list[str]
    steps: int
    modes: dict[str, int]
    reasons: dict[str, int]
    kl: float
    asked: int
    residual: float
    decision_ms: list[float] = field(repr=False)
    mass: list[float | None] = field(repr=False)
    certified: list[float | None] = field(repr=False)
    poses: list[list[float]] = field(repr=False)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> Record:
        return Record(**{**value, "start": tuple(value["start"])})


@lru_cache(maxsize=32)
def _method(experiment: Experiment, name: str) -> Method:
    return experiment.setting.method(name)


def run(experiment: Experiment, i: int, methods: Sequence[str]) -> list[Record]:
    """Run i by each method, in their order. Raises InfeasibleStart where no start can be found."""
    setting = experiment.setting
    shields = [setting.ours] if setting.learned is None else [setting.paper, setting.ours]
    return run_by(setting, i, {name: _method(experiment, name) for name in methods}, shields)


def run_by(
    setting: Setting, i: int, methods: Mapping[str, Method], shields: Sequence[Shield]
) -> list[Record]:
    """Run i by each of these methods, from a start that none of the shields refuses.

    Raises InfeasibleStart where no start can be found.
    """
    own = int(np.random.SeedSequence([setting.experiment.seed, i]).generate_state(1)[0])
    begun = _begin(setting, own, shields)
    return [_episode(setting, method, name, i, own, begun) for name, method in methods.items()]


@dataclass(frozen=True)
class _Beginning:
    """case: the world as it really is. refused: how many starts were drawn before and could not be used."""

    case: Case
    pose: Pose
    refused: int


def _begin(setting: Setting, own: int, shields: Sequence[Shield]) -> _Beginning:
    """The first start, of those drawn uniformly over free space, that none of the shields refuses.

    Where the world is not as the shield was told, the start has to be free in the real world too.
    """
    starts = free_poses(setting.case.task, setting.case.body, DRAWS, np.random.default_rng([own, START]))
    for refused, (x, y, theta) in enumerate(starts.tolist()):
        pose = (x, y, theta)
        if not all(_can_start(shield, pose) for shield in shields):
            continue
        random = np.random.default_rng([own, MISMATCH, 0])
        noise, way = setting.experiment.noise, partial(_certified_way, setting.ours, pose)
        case = disturbance.world(noise, setting.case, way, random)
        if not in_collision(case.body, *pose):
            return _Beginning(case, pose, refused)
    raise InfeasibleStart(
        f"none of {DRAWS} starts in {setting.case.name} can satisfy the rule", path="initial_pose"
    )


def _can_start(shield: Shield, pose: Pose) -> bool:
    try:
        start(shield, pose)
    except (InfeasibleStart, PoseError):
        return False
    return True


def _certified_way(shield: Shield, pose: Pose) -> Floats:
    """The poses of the continuation that is certified at the start. Shape [T + 1, 3]."""
    decision = decide(shield, [pose], None, main_task_done=True)
    actions = [decision.action, *(decision.witness or ())]
    poses = np.empty((len(actions), 3))
    simulate(shield.body, np.array(pose), shield.task.robot.motion_of[actions], poses)
    return np.concatenate([[pose], poses])


def _episode(setting: Setting, method: Method, name: str, i: int, own: int, begun: _Beginning) -> Record:
    experiment, case, model = setting.experiment, begun.case, setting.model
    robot = SimulatedRobot(case, begun.pose)
    draws = np.random.default_rng([own, DRAW]).random(MAX_STEPS + 1)
    shaken = np.random.default_rng([own, MISMATCH, 1])
    motion_of, terminal = case.task.robot.motion_of, case.task.robot.terminal
    poses = np.empty((MAX_STEPS + 1, 3))
    tally = _Tally()
    ended_at, main_done, t = None, False, 0
    method.begin(own)
    model.reset(np.random.default_rng([own, MODEL]))
    while True:
        poses[t] = robot.pose
        if t == experiment.main.limit:
            break
        logits = None if ended_at is not None else model.logits(robot)
        began = time.perf_counter()
        answer = method.act(poses[: t + 1], logits, draws[t])
        tally.count(answer, time.perf_counter() - began, logits is not None)
        if logits is not None and terminal[answer.action]:
            ended_at, main_done = t, is_done(model, robot)
        if answer.execute is None or (ended_at is not None and answer.spec_status != "pending"):
            break
        before = robot.pose
        robot.execute(answer.execute)
        robot.pose = disturbance.executed(experiment.noise, case.body, before, robot.pose, shaken)
        foreseen = step(setting.body, *before, motion_of[answer.execute])
        tally.residual = max(tally.residual, conformal.surprise(foreseen, robot.pose))
        t += 1
    states = np.concatenate([poses[: t + 1], np.repeat(poses[t : t + 1], max(case.task.horizon - t, 0), 0)])
    samples = case.task.samples(states)
    kept = {str(part): float(robustness(part, samples)) for part in conjuncts(case.task.formula)}
    rho = min(kept.values())
    return Record(
        run=i,
        method=name,
        seed=own,
        start=begun.pose,
        refused=begun.refused,
        satisfied=rho > SATISFIED_ABOVE,
        rho=rho,
        main_done=main_done,
        ended_at=ended_at,
        broken=[part for part, value in kept.items() if value <= SATISFIED_ABOVE],
        steps=t,
        modes=dict(tally.modes),
        reasons=dict(tally.reasons),
        kl=tally.kl,
        asked=tally.asked,
        residual=tally.residual,
        decision_ms=tally.milliseconds,
        mass=tally.mass,
        certified=tally.certified,
        poses=[[round(v, 4) for v in pose] for pose in poses[: t + 1].tolist()],
    )


class _Tally:
    """Sums over the decisions of an episode."""

    def __init__(self) -> None:
        self.modes: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.kl, self.asked, self.residual = 0.0, 0, 0.0
        self.mass: list[float | None] = []
        self.certified: list[float | None] = []
        self.milliseconds: list[float] = []

    def count(self, answer: Answer, seconds: float, for_model: bool) -> None:
        self.modes[answer.mode] += 1
        if answer.reason is not None:
            self.reasons[answer.reason] += 1
        if for_model:
            self.asked += 1
            self.kl += math.inf if answer.kl is None else answer.kl
        self.mass.append(_rounded(answer.feasible_mass))
        self.certified.append(_rounded(answer.robustness))
        self.milliseconds.append(round(1e3 * seconds, 3))


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
