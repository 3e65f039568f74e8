"""A robot's loop that goes on through an outage of the service, a bump, and a restart of its own process.

    make run                                                            # the service, in one terminal
    .venv/bin/python examples/robot_loop.py http://127.0.0.1:8000       # the robot, in another

Stop the service for a while, or stop this program with Ctrl-C and start it again: the rule is still kept.

Robot and model are simulated here. For your own, replace the two: `drive` needs a robot with a `pose`
(x [m], y [m], theta [rad], in the map's frame) and `execute(action)`, and a model with `logits(robot)`.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from specshield.client import Decision, LocalDecision, Session, ShieldClient, Verdict
from specshield.errors import NotFound, ServerError, Starting, StoreError, TransportError
from specshield.sim.cases import load_case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import Pose, SimulatedRobot

T = TypeVar("T")
Robust = Session[Decision | LocalDecision]  # whose steps answer also while the service is away
POLICY = "case1"  # the rule: visit a charger within 60 steps, and again between steps 80 and 140
START = (4.5, 5.0, 0.0)  # x [m], y [m], theta [rad]
AWAY = (TransportError, Starting, StoreError, ServerError)  # what a call raises while the service is away
PAUSE = 0.5  # [s] between two tries where there is nothing to do but wait
NOTES = Path("robot_loop.json")


@dataclass
class Notes:
    """What the robot must still know after a restart of its process. They are written before every motion.

    unsent: the poses, by step, that the service has not confirmed yet. pose: where the robot is.
    """

    session: str
    pose: Pose
    unsent: dict[int, Pose] = field(default_factory=dict)
    main_task_done: bool = False

    def write(self, file: Path) -> None:
        """Writes another file first: a process that is killed here leaves the old notes or the new ones."""
        beside = file.with_suffix(".new")
        beside.write_text(json.dumps(asdict(self)))
        os.replace(beside, file)

    @staticmethod
    def read(file: Path) -> Notes:
        kept = json.loads(file.read_text())
        kept["unsent"] = {int(t): tuple(pose) for t, pose in kept["unsent"].items()}
        return Notes(**kept | {"pose": tuple(kept["pose"])})


def drive(client: ShieldClient, robot: Any, model: Any, file: Path) -> Verdict:
    """Drives one session to its end, or goes on with the one that `file` tells of."""
    session = begin_or_resume(client, robot, file)
    while not session.finished:
        # While the service is away, the step follows the continuation that it certified last, and the service
        # hears of it later. Where there is nothing certified to do, `execute` is None: the robot stands.
        # A bump needs nothing here: the service certifies anew from the pose it is told.
        decision = session.step(robot.pose, None if session.main_task_done else model.logits(robot))
        Notes(session.id, robot.pose, session.unsent, session.main_task_done).write(file)
        if decision.execute is not None and not session.finished:
            robot.execute(decision.execute)
    verdict = patiently(lambda: session.close(robot.pose))
    file.unlink()
    return verdict


def begin_or_resume(client: ShieldClient, robot: Any, file: Path) -> Robust:
    if file.exists():
        notes = Notes.read(file)
        try:
            session = patiently(lambda: client.sessions.get(notes.session, on_failure="witness"))
        except NotFound:
            print("the service no longer knows the session of these notes: a new one begins")
        else:
            session.main_task_done = session.main_task_done or notes.main_task_done
            while session.t in notes.unsent:  # the steps of an outage that the service has not heard of yet
                session.record(notes.unsent[session.t])
            return session
    # Some room for surprises: visits are planned 8 steps early, and 5 cm inside the region.
    return patiently(
        lambda: client.sessions.create(
            policy_id=POLICY, initial_pose=robot.pose, slack=8, margin=0.05, on_failure="witness"
        )
    )


def patiently(call: Callable[[], T]) -> T:
    """The call's result, as soon as the service is there to give one."""
    while True:
        try:
            return call()
        except AWAY as error:  # noqa: PERF203
            print(f"waiting for the service: {error}")
            time.sleep(PAUSE)


def main() -> None:
    url = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:8000"
    case = load_case(POLICY)
    start = Notes.read(NOTES).pose if NOTES.exists() else START  # a real robot knows where it is
    robot, model = SimulatedRobot(case, start), GoalSeeker(case.task.robot)
    model.reset(np.random.default_rng(0))
    with ShieldClient(url) as client:
        try:
            verdict = drive(client, robot, model, NOTES)
        except KeyboardInterrupt:
            print("stopped" + (": start it again, and it goes on" if NOTES.exists() else ""))
            sys.exit(130)  # what a shell says of a program that Ctrl-C has ended
    print(f"the rule is {verdict.spec_status}")


if __name__ == "__main__":
    main()
