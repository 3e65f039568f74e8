"""The examples, each against a real server."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx
import numpy as np
import pytest

from examples import robot_loop
from specshield.client import ShieldClient
from specshield.sim.cases import load_case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import Pose, SimulatedRobot
from tests.serving import serving

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving(tmp_path_factory.mktemp("examples"), SPECSHIELD_WORKER="true") as server:
        yield server.url


def run(example: str, url: str, folder: Path) -> list[str]:
    """The lines that an example prints, run in `folder`."""
    command = [sys.executable, str(EXAMPLES / example), url]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_a_house_of_ones_own(url: str, tmp_path: Path) -> None:
    waiting, decided, from_where, kept = run("own_house.py", url, tmp_path)
    assert waiting == f"waiting for the service at {url} ..."
    assert decided.endswith("decided after 120 steps")
    assert re.search(r"(9\d|100)%", from_where)
    assert kept == "the rule is satisfied after 120 steps"


def test_a_loop_that_nothing_disturbs(url: str, tmp_path: Path) -> None:
    assert run("robot_loop.py", url, tmp_path)[-1] == "the rule is satisfied"
    assert not list(tmp_path.iterdir())  # the notes are gone with the session


class LosesAnswers(httpx.HTTPTransport):
    """The first answers to steps are lost, after the service has decided."""

    def __init__(self, answers: int) -> None:
        super().__init__()
        self.answers = answers

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        response = super().handle_request(request)
        if request.url.path.endswith("/steps") and self.answers > 0:
            self.answers -= 1
            response.close()
            raise httpx.ReadTimeout("lost", request=request)
        return response


def test_a_loop_whose_first_answers_are_lost(url: str, tmp_path: Path) -> None:
    """More of them than the SDK's own tries: the loop has to ask the very same question again."""
    case = load_case(robot_loop.POLICY)
    robot, model = SimulatedRobot(case, robot_loop.START), GoalSeeker(case.task.robot)
    model.reset(np.random.default_rng(0))
    lossy = LosesAnswers(7)
    with ShieldClient(url, timeout=30.0, transport=lossy) as client:
        verdict = robot_loop.drive(client, robot, model, tmp_path / "notes.json")
    assert lossy.answers == 0
    assert verdict.spec_status == "satisfied"


class Restart(Exception):
    """The robot's process ends here."""


class EventfulRobot(SimulatedRobot):
    """A robot to which things happen: `events[n]` before its n-th motion."""

    def __init__(self, pose: Pose, events: dict[int, Callable[[], None]]) -> None:
        super().__init__(load_case(robot_loop.POLICY), pose)
        self.events, self.motions = events, 0

    def execute(self, action: int) -> None:
        self.motions += 1
        self.events.pop(self.motions, lambda: None)()
        super().execute(action)


def test_a_loop_that_is_stopped_by_ctrl_c_says_so_and_goes_on(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ctrl_c() -> None:
        raise KeyboardInterrupt  # as Python does where the signal arrives

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["robot_loop.py", url])
    monkeypatch.setattr(robot_loop, "SimulatedRobot", lambda _, pose: EventfulRobot(pose, {5: ctrl_c}))
    with pytest.raises(SystemExit) as ended:
        robot_loop.main()
    assert ended.value.code == 130
    assert capsys.readouterr().out == "stopped: start it again, and it goes on\n"
    assert run("robot_loop.py", url, tmp_path)[-1] == "the rule is satisfied"


def test_a_loop_that_goes_on_through_outage_bump_and_restart(tmp_path: Path) -> None:
    """The service is killed and comes back, the robot is pushed, and its process is started again twice, once
    while the service is away."""
    notes = tmp_path / "notes.json"
    model = GoalSeeker(load_case(robot_loop.POLICY).task.robot)
    model.reset(np.random.default_rng(0))
    with ExitStack() as stack:
        server = stack.enter_context(serving(tmp_path / "data"))
        port = int(server.url.rpartition(":")[2])

        def push() -> None:
            robot.pose = (robot.pose[0] + 0.1, robot.pose[1] - 0.1, robot.pose[2] + 0.1)

        def end_process() -> None:
            raise Restart

        events = {8: server.kill, 12: end_process, 25: push, 35: end_process}
        robot = EventfulRobot(robot_loop.START, events)
        with ShieldClient(server.url, timeout=30.0) as client, pytest.raises(Restart):
            robot_loop.drive(client, robot, model, notes)
        stack.enter_context(serving(tmp_path / "data", port=port, ready=False))  # the next loop waits for it
        with ShieldClient(server.url, timeout=30.0) as client, pytest.raises(Restart):
            robot_loop.drive(client, robot, model, notes)
        session = robot_loop.Notes.read(notes).session
        with ShieldClient(server.url, timeout=30.0) as client:
            verdict = robot_loop.drive(client, robot, model, notes)
        with ShieldClient(server.url, timeout=60.0) as client:
            states = client.sessions.get(session).trajectory()
    assert verdict.spec_status == "satisfied"
    assert not notes.exists()
    assert not events
    undecided = [state.t for state in states[:-1] if state.decision is None]  # the last is the end
    assert undecided == [8, 9, 10, 11]  # where the robot followed its plan
    pushed = states[25].decision
    assert pushed is not None
    assert pushed["residual"]["translation"] > 0.05
