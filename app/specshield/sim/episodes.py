"""Drives one episode of a simulated robot with a model through the SDK, with the shield or without it."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from specshield.client import Decision, Session, ShieldClient, Verdict
from specshield.sim.cases import Case
from specshield.sim.model import FoundationModel, softmax
from specshield.sim.robot import Pose, SimulatedRobot

MAX_STEPS = 600


@dataclass
class Episode:
    """What happened in one episode; it is filled in while the episode runs.

    spec_status, robustness: the service's verdict on the poses, and its bounds (lo, hi) [m], None if
    unbounded. main_done: whether the model ended within 1 m of its target before MAX_STEPS. ended_at: the
    step of its `end`, None if never. modes: the number of decisions by mode. asked: the number of decisions
    while the rule was pending and the main task ran; spread: those of them that were `shaped` and left more
    than one action. kl: the distance of each decision from the model's distribution [nats]. round_trip_ms,
    server_ms: times of each decision. poses: x_0 ... x_t. session: the id of the session with these poses.
    """

    case: str
    seed: int
    start: Pose
    spec_status: str = "pending"
    robustness: tuple[float | None, float | None] = (None, None)
    main_done: bool = False
    ended_at: int | None = None
    modes: Counter[str] = field(default_factory=Counter)
    asked: int = 0
    spread: int = 0
    kl: list[float] = field(default_factory=list)
    round_trip_ms: list[float] = field(default_factory=list)
    server_ms: list[float] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    session: str = ""

    def judged(self, verdict: Verdict) -> Episode:
        self.spec_status, self.robustness = verdict.spec_status, verdict.robustness_bounds
        return self

    def ended(self, robot: SimulatedRobot) -> None:
        self.ended_at = len(self.poses) - 1
        self.main_done = robot.at_target and self.ended_at < MAX_STEPS

    def count(self, decision: Decision, seconds: float, main_over: bool) -> None:
        self.round_trip_ms.append(1e3 * seconds)
        self.server_ms.append(decision.timings.get("total", float("nan")))
        self.modes[decision.mode] += 1
        if main_over:
            return
        if decision.kl is not None:
            self.kl.append(decision.kl)
        if decision.spec_status == "pending":
            self.asked += 1
            self.spread += decision.mode == "shaped" and max(decision.distribution) < 1.0


def with_shield(session: Session, case: Case, model: FoundationModel, start: Pose, seed: int) -> Episode:
    """Drives with the shield: the model proposes, the service decides, the robot executes. `session` has just
    begun at `start`.
    """
    episode, robot = Episode(case.name, seed, start), SimulatedRobot(case, start)
    episode.session = session.id
    model.reset(np.random.default_rng([seed, 0]))
    with session:
        while not session.finished:
            episode.poses.append(robot.pose)
            main_over = session.main_task_done
            logits = None if main_over else model.logits(robot)
            began = time.perf_counter()
            decision = session.step(robot.pose, logits)
            episode.count(decision, time.perf_counter() - began, main_over)
            if session.main_task_done and not main_over:
                episode.ended(robot)
            if not session.finished:
                robot.execute(decision.execute)
        return episode.judged(session.close(robot.pose))


def without_shield(
    client: ShieldClient,
    case: Case,
    model: FoundationModel,
    start: Pose,
    seed: int,
    policy_id: str | None = None,
    id: str | None = None,
) -> Episode:
    """Drives without the shield: the robot executes the model's own draws; after `end` it stands still until
    the rule is decided. The service gives the verdict: the poses are recorded in a session without decisions.

    policy_id: a policy for the case's rule, by default the one that came with the case. id: of the session.
    """
    episode, robot = Episode(case.name, seed, start), SimulatedRobot(case, start)
    model.reset(np.random.default_rng([seed, 0]))
    random = np.random.default_rng([seed, 1])
    terminal = case.task.robot.terminal
    episode.poses.append(robot.pose)
    for _ in range(MAX_STEPS):
        action = int(random.choice(len(terminal), p=softmax(model.logits(robot))))
        if terminal[action]:
            episode.ended(robot)
            break
        robot.execute(action)
        episode.poses.append(robot.pose)
    still = case.task.horizon + 1 - len(episode.poses)
    episode.poses += [robot.pose] * max(still, 0)
    session = client.sessions.create(
        policy_id=policy_id or case.name, initial_pose=start, allow_infeasible=True, id=id
    )
    episode.session = session.id
    for pose in episode.poses[:-1]:
        session.record(pose)
    return episode.judged(session.close(episode.poses[-1]))
