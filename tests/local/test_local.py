"""The shield in process is the one that a server runs."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from specshield.client import ShieldClient
from specshield.errors import (
    HistoryConflict,
    HistoryGap,
    InfeasibleStart,
    InfeasibleSwitch,
    InputError,
    MapError,
    NotFound,
    PolicyError,
    SessionFinished,
)
from specshield.local import LocalShield
from specshield.local.shield import read_map_files
from specshield.robot import robot_from_json
from specshield.robot.dynamics import make_body, step
from specshield.service.library.maps import Maps
from specshield.service.settings import Settings
from specshield.world.map_server import dump_map
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Circle
from tests.service.world import grid_json, policy_files, send_policy
from tests.serving import RunningServer

START = (4.5, 5.0, 0.0)
ROBOT = {
    "footprint": {"radius": 0.2},
    "actions": [
        {"name": "forward", "translate": 0.25},
        {"name": "left", "rotate": 0.5},
        {"name": "right", "rotate": -0.5},
        {"name": "end", "terminal": True},
    ],
}
SETTINGS = [
    {},
    {"uncertainty": "none", "learn_map": False, "seed": 3},
    {"uncertainty": "none", "threshold": 0.6},
    {"uncertainty": "none", "evaluation": "robustness", "threshold": 0.1, "margin": 0.05},
    {"uncertainty": "none", "shaping": "lookahead"},
]


@pytest.mark.parametrize("settings", SETTINGS)
def test_a_server_decides_the_same_to_the_bit(server: RunningServer, settings: dict[str, object]) -> None:
    """A whole episode with a model that wanders, ends its task, and a robot that does not land exactly."""
    options = {"initial_pose": START, "max_steps": 150, **settings}
    random = np.random.default_rng(7)
    with ShieldClient(server.url, timeout=300.0) as client:
        remote = client.sessions.create(policy_id="case1", **options)
        local = LocalShield.shipped("case1").session(**options)
        assert replace(remote.info, id="", expires_at="", map_id="", spec={}, rules=()) == replace(
            local.info, id="", expires_at="", map_id="", spec={}, rules=()
        )
        pose = START
        while not local.finished and local.t < 150:
            logits = None if local.main_task_done else random.normal(0.0, 1.5, 20)
            if logits is not None:
                logits[4] = 5.0 if local.t == 40 else -np.inf
            seen = {"occupied": [], "free": [pose[:2]]}  # a server makes tables for a map that has changed
            asked = {"explain": True, "witnesses": True, **seen} if local.t % 10 == 5 else {}
            here = local.step(pose, logits, **asked)
            there = remote.step(pose, logits, **asked)
            assert here == replace(there, timings={})
            assert (local.t, local.spec_status, local.main_task_done, local.finished) == (
                remote.t, remote.spec_status, remote.main_task_done, remote.finished,
            )  # fmt: skip
            x, y, theta = here.next_poses[here.execute]
            shake = random.normal(0.0, 0.003, 3)
            pose = (x + shake[0], y + shake[1], theta + shake[2])
        assert local.t >= 81
        assert local.close(pose) == remote.close(pose)
        with pytest.raises(SessionFinished):
            local.step(pose, random.normal(size=20))
        assert [
            json.loads(json.dumps([each.t, each.pose, each.signals, each.decision]))
            for each in local.trajectory()
        ] == [
            json.loads(json.dumps([each.t, each.pose, each.signals, each.decision]))
            for each in remote.trajectory()
        ]
        assert local.trajectory(after=78) == local.trajectory()[79:]
        assert [each.t for each in remote.trajectory(after=78)] == [each.t for each in local.trajectory(78)]
        with pytest.raises(InputError, match=r"^after.* got 'x'"):
            remote.trajectory(after="x")


def test_a_server_switches_the_same(server: RunningServer) -> None:
    """The same rule with a new clock, then by another policy with the clock kept; then one that cannot be."""
    random = np.random.default_rng(3)
    with ShieldClient(server.url, timeout=300.0) as client:
        remote = client.sessions.create(policy_id="case1", initial_pose=START, seed=5)
        local = LocalShield.shipped("case1").session(initial_pose=START, seed=5)
        pose = START
        for t in range(60):
            if t == 20:
                told = (
                    remote.switch("case1", clock="restart", pose=pose),
                    local.switch(LocalShield.shipped("case1"), clock="restart", pose=pose),
                )
            if t == 40:
                told = remote.switch("case1-dqn"), local.switch(LocalShield.shipped("case1-dqn"))
            if t in (20, 40):
                there, here = told
                assert [rule["spec_status"] for rule in there.rules] == [
                    rule["spec_status"] for rule in here.rules
                ]
                assert (there.spec_status, there.next_t, there.any_signal) == (
                    here.spec_status, here.next_t, here.any_signal,
                )  # fmt: skip
            logits = random.normal(0.0, 1.0, 20)
            logits[4] = -np.inf
            decision = local.step(pose, logits, deadline=0.1)
            assert decision == replace(remote.step(pose, logits), timings={})
            pose = decision.next_poses[decision.execute]
        assert [(each.t, each.rule) for each in local.trajectory()] == [
            (each.t, each.rule) for each in remote.trajectory()
        ]
        assert [decision.t for decision in local.events(55)] == [56, 57, 58, 59]
        wall = LocalShield.make(LocalShield.shipped("case1").task.grid, "F[0,3] x > 9 and F[0,3] x < 1")
        with pytest.raises(InfeasibleSwitch):
            local.switch(wall, clock="restart")
        assert local.info.rules[-1]["policy_ids"] == local.info.policy_ids
        assert local.close(pose) == remote.close(pose)


def test_a_model_that_ends_is_asked_again_under_another_rule(server: RunningServer, tmp_path: Path) -> None:
    """The rule is kept and `end` drawn: no server has been told so, and another rule is taken."""
    begins = (1.0, 1.5, 0.0)
    rules = ({"formula": "F[0,5] x > 0.5", "regions": {}}, {"formula": "F[0,20] x > 1.5", "regions": {}})
    there, here = _both(server, tmp_path, *rules)
    with ShieldClient(server.url, timeout=60.0) as sdk:
        remote = sdk.sessions.create(policy_id=there[0], initial_pose=begins)
        local = here[0].session(initial_pose=begins)
        ending = [None, None, None, None, 0.0]
        assert local.step(begins, ending) == replace(remote.step(begins, ending), timings={})
        assert local.finished
        taken = remote.switch(there[1]), local.switch(here[1])
        assert {(each.spec_status, each.finished) for each in (*taken, local)} == {("pending", False)}
        assert [each.main_task_done for each in taken] == [False, False]  # no step has said so
        pose = begins
        while not local.finished:
            decision = local.step(pose)
            assert decision == replace(remote.step(pose), timings={})
            pose = decision.next_poses[decision.execute]
        assert local.spec_status == "satisfied"
        decided = [rule["formula"] for rule in rules]
        assert [local.rule_at(t) for t in (0, 1)] == [remote.rule_at(t) for t in (0, 1)] == decided
        for session, last in ((remote, there[0]), (local, here[0])):
            with pytest.raises(SessionFinished):
                session.switch(last)


def _both(server: RunningServer, folder: Path, *specs: dict[str, Any]) -> tuple[list[str], list[LocalShield]]:
    """Policies of zeros for these rules: their ids on the server, and the same in process."""
    there, here = list[str](), list[LocalShield]()
    with httpx.Client(base_url=server.url, verify=False, timeout=60.0) as client:
        assert client.post("/v1/maps", json=grid_json()).status_code in (200, 201)
        for spec in specs:
            there.append(send_policy(client, spec=spec)["id"])
            parts = policy_files(spec)
            (folder / "policy.safetensors").write_bytes(parts["weights"])
            (folder / "card.json").write_bytes(parts["card"])
            here.append(LocalShield.load(folder, grid_json()))
    return there, here


PLAIN: dict[str, Any] = {"formula": "F[0,30] x > 1.9", "regions": {}}
READS: dict[str, Any] = {
    "formula": "F[0,30] x > 2 and G[0,30] battery > 1", "regions": {}, "signals": {"battery": 9.0},
}  # fmt: skip


@pytest.mark.parametrize("clock", ["keep", "restart"])
@pytest.mark.parametrize("steps", [0, 3])
@pytest.mark.parametrize("rules", [(READS, PLAIN), (PLAIN, READS), (READS, {**READS, "formula": "x > 0.1"})])
def test_a_server_switches_the_same_without_a_pose_where_rules_read_signals(
    server: RunningServer, tmp_path: Path, rules: tuple[dict[str, Any], ...], steps: int, clock: Any
) -> None:
    """x_t is where the last decision's action leads; at first, where the session began."""
    there, here = _both(server, tmp_path, *rules)
    pose = (1.0, 1.5, 0.0)
    with ShieldClient(server.url, timeout=60.0) as sdk:
        remote = sdk.sessions.create(policy_id=there[0], initial_pose=pose)
        local = here[0].session(initial_pose=pose)
        for t in range(steps + 4):
            if t == steps:
                told, mine = remote.switch(there[1], clock=clock), local.switch(here[1], clock=clock)
                same = ("spec_status", "next_t", "any_signal", "feasible", "horizon")
                assert [getattr(told, name) for name in same] == [getattr(mine, name) for name in same]
                same = ("from", "origin", "clock", "formula", "horizon", "spec_status")
                assert [[rule[name] for name in same] for rule in told.rules] == [
                    [rule[name] for name in same] for rule in mine.rules
                ]
            reads = "battery" in local.task.signals or (t >= steps and rules[0] is READS)
            signals = (
                {"battery": 9.0 - 0.1 * t} if reads else None
            )  # what the rule before read may be sent on
            decision = local.step(pose, [0.5, 0.0, 0.0, 0.2, None], signals=signals)
            asked = remote.step(pose, [0.5, 0.0, 0.0, 0.2, None], signals=signals)
            assert decision == replace(asked, timings={})
            pose = decision.next_poses[decision.execute]


def test_what_a_rule_led_to_counts_for_it_after_a_switch(server: RunningServer, tmp_path: Path) -> None:
    """The pose that decides the rule that was left comes after the switch, with the step of the next rule."""
    kept = {"formula": "F[0,2] x > 1.1", "regions": {}}
    there, here = _both(server, tmp_path, kept, READS)
    pose = (1.0, 1.5, 0.0)
    with ShieldClient(server.url, timeout=60.0) as sdk:
        remote = sdk.sessions.create(policy_id=there[0], initial_pose=pose)
        local = here[0].session(initial_pose=pose)
        pose = local.step(pose, [9.0, None, None, None, None], main_task_done=True).next_poses[0]
        remote.step((1.0, 1.5, 0.0), [9.0, None, None, None, None], main_task_done=True)
        for info in (remote.switch(there[1], clock="restart"), local.switch(here[1], clock="restart")):
            assert [rule["spec_status"] for rule in info.rules] == ["pending", "pending"]
            assert info.main_task_done
        for session in (remote, local):
            session.step(pose, signals={"battery": 8.0})
        assert [rule["spec_status"] for rule in local.info.rules] == ["satisfied", "pending"]
        assert local.info.spec_status == "pending"
        again = sdk.sessions.get(remote.id).info.rules
        assert [rule["spec_status"] for rule in again] == ["satisfied", "pending"]
        assert [(each.t, each.rule, each.signals) for each in local.trajectory()] == [
            (each.t, each.rule, each.signals) for each in remote.trajectory()
        ]


FORTH_AND_BACK = (0,) * 12 + (1,) * 6 + (0,) * 12 + (1,) * 6  # twelve moves, half a turn to the left


@pytest.mark.parametrize("radii", [(0.2, 0.2), (0.1, 0.2)], ids=["another map", "a larger robot"])
def test_where_a_robot_has_been_tells_nothing_of_another_map_nor_of_what_stops_a_larger_robot(
    radii: tuple[float, float],
) -> None:
    """Something that is on no map stands where it drove before the switch. It runs into it once and goes
    around, as it does where the switch begins a new history.
    """
    cells = np.pad(np.zeros((38, 78), np.bool_), 1, constant_values=True)
    first, second = OccupancyGrid(cells, 0.05), OccupancyGrid(cells, 0.05)
    if radii[0] == radii[1]:
        cells = cells.copy()
        cells[1, 1] = True
        first = OccupancyGrid(cells, 0.05)
    goal = {"Goal": {"type": "circle", "center": [3.4, 1.0], "radius": 0.3}}
    turn = np.radians(30.0)
    moves = ({"translate": 0.2}, {"rotate": turn}, {"rotate": -turn}, {"translate": -0.2}, {})
    actions = [{"name": str(i), **move} for i, move in enumerate(moves)]
    robots = [{"footprint": {"radius": r}, "on_contact": "stop", "actions": actions} for r in radii]
    world = second.occupied.copy()
    world[16:23, 38:42] = True  # 0.35 m wide, in the middle of the way
    body = make_body(robot_from_json(robots[1]), OccupancyGrid(world, 0.05))
    before = LocalShield.make(first, "F[0,90] Goal", goal, robot=robots[0], check=False)
    wishes = [0.0, -30.0, -30.0, -30.0, -30.0]
    ended = list[tuple[int, int]]()
    for clock, begins in (("restart", 0), ("keep", len(FORTH_AND_BACK))):
        rule = f"F[{begins},{begins + 50}] Goal"
        after = LocalShield.make(second, rule, goal, robot=robots[1], check=False)
        session, pose, bumps = before.session(initial_pose=(0.6, 1.0, 0.0)), (0.6, 1.0, 0.0), 0
        for motion in FORTH_AND_BACK:
            pose = session.step(pose, wishes).next_poses[motion]
        there = (pose[0] - 0.05, pose[1], pose[2])
        session.switch(after, clock=clock, pose=there)  # type: ignore[arg-type]
        pose = there
        while session.spec_status == "pending":
            decision = session.step(pose, wishes)
            foreseen, pose = decision.next_poses[decision.execute], step(body, *pose, decision.execute)
            bumps += np.hypot(foreseen[0] - pose[0], foreseen[1] - pose[1]) > 1e-3
        assert session.spec_status == "satisfied", clock
        ended.append((session.t, bumps))
    assert ended[0] == ended[1]
    assert ended[0][1] == 1


@pytest.mark.parametrize("learn_map", [True, False])
@pytest.mark.parametrize("decided", [True, False], ids=["decided", "passed over"])
def test_a_robot_that_was_taken_to_another_map_is_not_said_to_have_jumped(
    small: LocalShield, other: LocalShield, learn_map: bool, decided: bool
) -> None:
    session = small.session(initial_pose=(3.0, 3.0, 0.0), learn_map=learn_map)
    if decided:
        session.step((3.0, 3.0, 0.0), [0.0] * 4)
    else:
        session.record((3.0, 3.0, 0.0))
    session.switch(other, pose=(2.0, 6.5, 0.0))
    assert session.step((2.0, 6.5, 0.0), [0.0] * 4).warnings == ()
    session.record((2.0, 6.5, 0.0))
    assert "is 2.5 m from the one before" in " ".join(session.step((2.0, 4.0, 0.0), [0.0] * 4).warnings)


@pytest.mark.parametrize("flag", ["main_task_done", "witnesses", "explain"])
def test_a_flag_that_is_no_yes_or_no_is_refused_as_the_sdk_does(flag: str) -> None:
    session = LocalShield.shipped("case1").session(initial_pose=START)
    asked: dict[str, Any] = {flag: "no"}
    with pytest.raises(InputError) as caught:
        session.step(START, [0.0] * 20, **asked)
    assert (caught.value.path, session.t) == (flag, 0)


def test_after_a_step_without_a_decision_a_switch_needs_the_pose(
    server: RunningServer, tmp_path: Path
) -> None:
    there, here = _both(server, tmp_path, PLAIN, READS)
    pose = (1.0, 1.5, 0.0)
    with ShieldClient(server.url, timeout=60.0) as sdk:
        remote = sdk.sessions.create(policy_id=there[0], initial_pose=pose)
        local = here[0].session(initial_pose=pose)
        for session, other in ((remote, there[1]), (local, here[1])):
            session.record(pose)
            with pytest.raises(HistoryGap):
                session.switch(other)
            assert session.switch(other, pose=pose).next_t == 1
            assert session.switch(other).next_t == 1  # x_t is known by now


def test_a_pose_that_a_switch_told_stands_and_the_same_switch_again_is_the_one_made(
    server: RunningServer,
) -> None:
    """As on a server: x_t is among the states, counts for the verdict, and the step that follows keeps it."""
    with ShieldClient(server.url, timeout=300.0) as client:
        remote = client.sessions.create(policy_id="case1", initial_pose=START)
        local = LocalShield.shipped("case1").session(initial_pose=START)
        pose = remote.step(START, np.zeros(20)).next_poses[1]
        local.step(START, np.zeros(20))
        for session, policy in ((remote, "case1-dqn"), (local, LocalShield.shipped("case1-dqn"))):
            for _ in range(2):
                session.switch(policy, clock="restart", pose=pose)
            elsewhere = (pose[0] + 0.01, *pose[1:])
            for refused in (
                lambda: session.switch(policy, clock="restart", pose=elsewhere),  # noqa: B023
                lambda: session.step(elsewhere, np.zeros(20)),  # noqa: B023
            ):
                with pytest.raises(HistoryConflict):
                    refused()
            with pytest.raises(HistoryConflict):
                session.close(elsewhere)
            session.record(elsewhere)
            session.step(elsewhere, np.zeros(20))
        assert len(local.info.rules) == len(remote.info.rules) == 2
        assert [each.pose for each in local.trajectory()] == [each.pose for each in remote.trajectory()]
        assert local.close() == remote.close()


@pytest.fixture(scope="module")
def switched() -> tuple[LocalShield, ...]:
    """What a session begins with, what it may switch to, and what it may not."""
    grid = LocalShield.shipped("case1").task.grid
    first, then = (
        LocalShield.make(grid, formula, signals={"battery": 9.0}, robot=ROBOT, check=False)
        for formula in ("F[0,90] x > 1 and G[0,90] battery > 1", "F[0,99] x > 1 and G[0,99] battery > 2")
    )
    wall = LocalShield.make(grid, "F[0,3] x > 9 and F[0,3] x < 1", robot=ROBOT, check=False)
    return first, then, wall


@pytest.mark.parametrize("clock", ["keep", "restart"])
def test_a_switch_that_fails_leaves_everything_as_it_was(
    switched: tuple[LocalShield, ...], monkeypatch: pytest.MonkeyPatch, clock: Any
) -> None:
    """Whether it is refused, or something of it breaks at the very end."""
    first, then, wall = switched
    tried, plain = (first.session(initial_pose=START) for _ in range(2))

    def broken(*_: Any) -> bool:
        raise RuntimeError

    pose = START
    for _ in range(6):
        decision, expected = (each.step(pose, [1.0, 0.0, 0.0, -3.0]) for each in (tried, plain))
        assert decision == expected
        pose = decision.next_poses[decision.execute]
        before = {
            name: value.copy() if isinstance(value, list | dict) else value
            for name, value in vars(tried).items()
        }
        with pytest.raises(InfeasibleSwitch):
            tried.switch(wall, clock=clock)
        with monkeypatch.context() as patched:
            patched.setattr("specshield.local.session.any_signal", broken)
            with pytest.raises(RuntimeError):
                tried.switch(then, clock=clock)
        assert vars(tried) == before
        assert (tried.task, len(tried.info.rules)) == (first.task, 1)
    assert tried.trajectory() == plain.trajectory()


def test_a_policy_made_on_the_spot_is_the_same_from_its_folder(tmp_path: Path) -> None:
    occupied = np.zeros((30, 40), bool)
    occupied[10:20, 15] = True
    regions = {"Dock": {"type": "circle", "center": [8.0, 6.0], "radius": 0.6}}
    made = LocalShield.make(
        OccupancyGrid(occupied, 0.25), "F[0,60] Dock and G[0,90] load < 5", regions,
        signals={"load": 0.0}, robot=ROBOT,
    )  # fmt: skip
    assert len(repr(made)) < 100  # what a notebook shows
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"cannot be written there: Not a directory; got '.*/file/policy'"):
        made.save(tmp_path / "file" / "policy")
    made.save(tmp_path / "policy")
    again = LocalShield.load(tmp_path / "policy")
    sessions = [each.session(initial_pose=(1.0, 1.0, 0.0)) for each in (made, again)]
    pose, statuses = (1.0, 1.0, 0.0), set()
    for t in range(91):
        signals = {"load": 3.0} if t == 70 else None
        decisions = [session.step(pose, [1.0, 0.0, 0.0, -3.0], signals=signals) for session in sessions]
        assert decisions[0] == decisions[1]
        statuses.add(decisions[0].spec_status)
        pose = decisions[0].next_poses[decisions[0].execute]
    assert statuses == {"pending", "satisfied"}
    assert [item.signals["load"] for item in sessions[0].trajectory()][69:72] == [0.0, 3.0, 3.0]


def test_a_map_has_the_image_that_its_yaml_names(tmp_path: Path) -> None:
    """As `specshield policy` has it. An image of the YAML's own name may be an older one."""
    newer, older = OccupancyGrid(np.eye(30, dtype=bool), 0.25), OccupancyGrid(np.zeros((30, 30), bool), 0.25)
    metadata, image = dump_map(newer, "newer.pgm")
    (tmp_path / "floor.yaml").write_text(metadata)
    (tmp_path / "newer.pgm").write_bytes(image)
    assert read_map_files(tmp_path / "floor.yaml") == (newer, {})
    (tmp_path / "floor.pgm").write_bytes(dump_map(older)[1])
    assert LocalShield.make(tmp_path / "floor.yaml", "F[0,9] x > 1", check=False).task.grid == newer
    (tmp_path / "newer.pgm").unlink()
    assert read_map_files(tmp_path / "floor.yaml") == (older, {})
    (tmp_path / "floor.pgm").unlink()
    (tmp_path / "newer.bmp").touch()  # of a kind that is not read
    for named in ("newer.pgm", "newer.bmp"):
        (tmp_path / "floor.yaml").write_text(metadata.replace("newer.pgm", named))
        with pytest.raises(MapError, match="image is not beside its YAML"):
            read_map_files(tmp_path / "floor.yaml")
    (tmp_path / "house.json").write_text('{"rooms": []}')  # which is YAML too, and no map_server's
    (tmp_path / "newer.pgm").write_bytes(image)
    (tmp_path / "floor.yaml").write_text(metadata.replace("[0.0, 0.0, 0.0]", "[0, 0, 90]"))
    with pytest.raises(MapError, match="radians"):  # as where a server is sent it
        LocalShield.make(tmp_path / "floor.yaml", "F[0,9] x > 1", check=False)
    for name, said in (
        ("", "no map can be read"),
        ("none.yaml", "no such file"),
        ("house.json", "no map can be read"),
    ):
        with pytest.raises(MapError, match=said):
            LocalShield.make(tmp_path / name, "F[0,9] x > 1")


@pytest.mark.parametrize("card", [None, "", "[]", "{}", '{"robot": {}, "spec": []}'])
def test_a_folder_without_a_policy_is_said_to_have_none(card: str | None, tmp_path: Path) -> None:
    if card is not None:
        (tmp_path / "card.json").write_text(card)
    with pytest.raises(PolicyError, match="folder: no policy can be read there") as refused:
        LocalShield.load(tmp_path)
    assert refused.value.got == str(tmp_path)


def test_what_is_wrong_is_said() -> None:
    with pytest.raises(NotFound, match="case1, case1-dqn"):
        LocalShield.shipped("case9")
    shield = LocalShield.shipped("case1")
    session = shield.session(initial_pose=START)
    with pytest.raises(HistoryConflict, match="another pose for step 0 already, its initial_pose"):
        session.step((4.0, 5.0, 0.0), np.zeros(20))
    session.step((*START[:2], 2 * np.pi), np.zeros(20))
    wall = OccupancyGrid(np.repeat([[0, 0, 0, 1, 0, 0, 0]], 7, axis=0) > 0, 1.0)
    with pytest.raises(InfeasibleStart):
        LocalShield.make(wall, "F[0,60] x > 5", robot=ROBOT).session(initial_pose=(1.5, 1.5, 0.0))


def test_what_is_no_world_is_told_by_its_type() -> None:
    cells: Any = np.zeros((20, 20), bool)
    with pytest.raises(MapError, match="this is no world; got 'a ndarray'; expected an OccupancyGrid"):
        LocalShield.make(cells, "F[0,9] x > 1")


@pytest.mark.parametrize(
    ("areas", "said"),
    [
        ("{", "floor.regions.json cannot be read: Expecting property name"),
        ("\x80", "floor.regions.json cannot be read"),
        ("[]", "floor.regions.json is not a usable object"),
        ('{"rooms": null}', "floor.regions.json.rooms is not a usable object"),
        ('{"regions": {"Dock": 1}}', "floor.regions.json.Dock is not a usable object"),
    ],
)
def test_a_file_of_areas_that_cannot_be_used_is_named(tmp_path: Path, areas: str, said: str) -> None:
    """A server leaves such a map out, and says why in its log. It did not start."""
    metadata, image = dump_map(OccupancyGrid(np.zeros((30, 30), bool), 0.25), "floor.pgm")
    (tmp_path / "floor.yaml").write_text(metadata)
    (tmp_path / "floor.pgm").write_bytes(image)
    (tmp_path / "floor.regions.json").write_bytes(areas.encode("latin-1"))
    with pytest.raises(MapError, match=said):
        LocalShield.make(tmp_path / "floor.yaml", "F[0,9] x > 1", check=False)
    assert Maps(Settings(maps_dir=tmp_path, data_dir=tmp_path / "data")).shipped("floor") is None


def test_rooms_are_given_like_regions_and_a_wrong_one_is_named() -> None:
    grid = OccupancyGrid(np.zeros((30, 30), bool), 0.25)
    place = {"type": "circle", "center": np.array([2.0, 2.0]), "radius": 0.5}
    made = LocalShield.make(grid, "F[0,40] Attic", rooms={"Attic": place}, robot=ROBOT, check=False)
    assert made.task.regions == {"Attic": Circle((2.0, 2.0), 0.5)}
    for given, path in (({"rooms": {"Attic": 1}}, "rooms.Attic"), ({"regions": {1: place}}, "regions.1")):
        with pytest.raises(MapError) as caught:
            LocalShield.make(grid, "F[0,40] Attic", **given)
        assert caught.value.path == path


def test_a_card_without_an_id_is_refused_where_it_is_read(tmp_path: Path) -> None:
    grid = OccupancyGrid(np.zeros((30, 30), bool), 0.25)
    LocalShield.make(grid, "F[0,40] x > 4", robot=ROBOT, check=False).save(tmp_path)
    card = json.loads((tmp_path / "card.json").read_text())
    (tmp_path / "card.json").write_text(json.dumps({n: v for n, v in card.items() if n != "id"}))
    with pytest.raises(PolicyError, match="which has an id"):
        LocalShield.load(tmp_path)


@pytest.mark.parametrize("rule", ["F[0,10] 0 > 1", "G[0,10] 0 >= 0"])
def test_a_rule_that_reads_nothing_and_does_not_hold_is_proved_to_fail(rule: str) -> None:
    floor = OccupancyGrid(np.zeros((9, 9), bool), 1.0)
    with pytest.raises(InfeasibleStart, match="reads neither poses nor signals") as caught:
        LocalShield.make(floor, rule, robot=ROBOT).session(initial_pose=(4.0, 4.0, 0.0))
    assert caught.value.details == {"proved": True, "conjuncts": []}


def test_a_missing_part_is_told_with_the_extra_that_brings_it() -> None:
    code = "import sys; sys.modules['scipy'] = None; import specshield.local"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    told = "ModuleNotFoundError: specshield.local needs scipy: pip install 'specshield[core]'"
    assert done.stderr.splitlines()[-1] == told


def test_no_web_part_is_imported() -> None:
    code = "import specshield.local, specshield.client.models, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    web = {"httpx", "fastapi", "starlette", "pydantic", "redis", "rq", "uvicorn", "torch"}
    assert not web & set(done.stdout.split())


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"uncertainty": "Learned"}, "uncertainty"),
    ({"uncertainty": None}, "uncertainty"),
    ({"uncertainty": 3}, "uncertainty"),
    ({"uncertainty": {"foo": 1}}, "uncertainty.translation"),
    ({"uncertainty": {"translation": 0.1, "rotation": 0.1, "foo": 1}}, "uncertainty.foo"),
    ({"uncertainty": {"translation": "a", "rotation": 0.1}}, "uncertainty.translation"),
    ({"uncertainty": {"translation": 0.1, "rotation": 0.1, "slip": 2}}, "uncertainty.slip"),
    ({"threshold": "a"}, "threshold"),
    ({"threshold": float("nan")}, "threshold"),
    ({"threshold": 0.0}, "threshold"),
    ({"threshold": None}, "threshold"),
    ({"threshold_over": "foo"}, "threshold_over"),
    ({"threshold_over": None}, "threshold_over"),
    ({"learn_map": "no"}, "learn_map"),
    ({"learn_map": 1}, "learn_map"),
    ({"allow_infeasible": "x"}, "allow_infeasible"),
    ({"slack": 1.5}, "slack"),
    ({"slack": "3"}, "slack"),
    ({"slack": True}, "slack"),
    ({"slack": -1}, "slack"),
    ({"margin": "x"}, "margin"),
    ({"margin": float("inf")}, "margin"),
    ({"max_steps": 700.5}, "max_steps"),
    ({"max_steps": 0}, "max_steps"),
    ({"map_memory": 2.5}, "map_memory"),
    ({"map_memory": 0}, "map_memory"),
    ({"seed": 1.5}, "seed"),
    ({"seed": "x"}, "seed"),
    ({"seed": -1}, "seed"),
    ({"seed": 2**63}, "seed"),
    ({"evaluation": "foo"}, "evaluation"),
    ({"shaping": ["projection"]}, "shaping"),
    ({"id": 5}, "id"),
    ({"colour": "red"}, "colour"),
    ({"initial_pose": None}, "initial_pose"),
    ({"initial_pose": (4.5, 5.0)}, "initial_pose"),
]


@pytest.fixture(scope="module")
def small() -> LocalShield:
    grid = OccupancyGrid(np.zeros((30, 30), bool), 0.25)
    return LocalShield.make(grid, "F[0,40] x > 4", robot=ROBOT, check=False)


@pytest.fixture(scope="module")
def other() -> LocalShield:
    return LocalShield.make(OccupancyGrid(np.eye(30) > 0, 0.25), "F[0,40] x > 4", robot=ROBOT, check=False)


@pytest.mark.parametrize(("settings", "path"), WRONG, ids=str)
def test_a_setting_that_a_server_refuses_is_refused(
    server: RunningServer, small: LocalShield, settings: dict[str, Any], path: str
) -> None:
    """With the same path, at the latest when the session begins."""
    with pytest.raises(InputError) as here:
        small.session(**{"initial_pose": (3.0, 3.0, 0.0), **settings})
    assert here.value.path == path
    assert here.value.expected
    body = {"policy_id": "case1", "initial_pose": START, **settings}
    sent = json.dumps(body, default=str)
    with httpx.Client(base_url=server.url, verify=False, timeout=60.0) as client:
        answer = client.post("/v1/sessions", content=sent, headers={"content-type": "application/json"})
    if "NaN" not in sent and "Infinity" not in sent:
        assert answer.status_code == 422, answer.text
        told = answer.json()
        assert any(str(each["path"]).startswith(path) for each in told.get("errors", [told])), told


@pytest.mark.parametrize("seed", [-1, 1.5, "x", 2**63])
def test_a_seed_that_a_server_refuses_makes_no_policy(seed: Any) -> None:
    grid = OccupancyGrid(np.zeros((30, 30), bool), 0.25)
    with pytest.raises(InputError, match="a whole number from 0 to 9223372036854775807") as told:
        LocalShield.make(grid, "F[0,40] x > 4", robot=ROBOT, seed=seed, check=False)
    assert told.value.path == "seed"


def test_a_threshold_of_0_metres_is_taken_here_and_there(server: RunningServer) -> None:
    """A server refused it, as though it were a probability, of which 0 asks for nothing."""
    asked: dict[str, Any] = {"initial_pose": START, "evaluation": "robustness", "threshold": 0.0}
    with ShieldClient(server.url, timeout=60.0) as client:
        there = client.sessions.create(policy_id="case1", **asked).info
    assert there.feasible is LocalShield.shipped("case1").session(**asked).info.feasible is True


def test_a_setting_may_come_from_numpy_and_what_is_known_of_the_robot_is_as_on_a_server(
    server: RunningServer,
) -> None:
    """A slip that is not said is none."""
    known = {"translation": 0.02, "rotation": 0.01}
    options: dict[str, Any] = {
        "initial_pose": np.array(START), "seed": np.int64(3), "slack": np.int32(2),
        "margin": np.float32(0.25), "learn_map": np.bool_(False), "uncertainty": known,
    }  # fmt: skip
    local = LocalShield.shipped("case1").session(**options)
    plain = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in options.items()}
    with ShieldClient(server.url, timeout=300.0) as client:
        remote = client.sessions.create(policy_id="case1", **plain)
        logits = np.zeros(20)
        assert local.step(START, logits) == replace(remote.step(START, logits), timings={})


def test_what_a_policy_is_made_of_may_come_from_numpy_as_in_the_sdk() -> None:
    def made(listed: Any, number: Any) -> Any:
        turn = {"x": 0.0, "y": 0.0, "z": 0.0, "w": number(1.0)}
        origin = {"position": {"x": number(0.0), "y": 0.0, "z": 0.0}, "orientation": turn}
        info = {"resolution": number(0.25), "width": 20, "height": 20, "origin": origin}
        dock = {"type": "circle", "center": listed([3.0, 3.0]), "radius": number(0.5)}
        move = {"name": "forward", "translate": number(0.25)}
        return LocalShield.make(
            {"format": "occupancy_grid", "info": info, "data": listed([0] * 400)},
            "F[0,40] Dock and G[0,40] battery > 1",
            {"Dock": dock},
            signals={"battery": number(3.0)},
            robot={"footprint": {"radius": number(0.25)}, "actions": [move, {"name": "wait"}]},
            check=False,
        ).card["id"]

    assert made(np.array, np.float32) == made(list, float)


@pytest.mark.parametrize(
    ("asked", "path"),
    [
        ({"signals": 5}, "signals"),
        ({"signals": [1.0]}, "signals"),
        ({"signals": {"x": "a"}}, "signals.x"),
        ({"occupied": 5}, "occupied"),
        ({"free": np.float64(5.0)}, "free"),
        ({"occupied": [1, 2]}, "occupied[0]"),
        ({"logits": [10**400, 0, 0, 0]}, "logits"),
        ({"occupied": [[1e9, 2]]}, "occupied[0]"),
        ({"deadline": -1.0}, "deadline"),
    ],
)
def test_what_a_step_cannot_read_is_said_and_changes_nothing(
    small: LocalShield, asked: dict[str, Any], path: str
) -> None:
    session = small.session(initial_pose=(3.0, 3.0, 0.0))
    with pytest.raises(InputError) as error:
        session.step((3.0, 3.0, 0.0), **{"logits": np.zeros(4), **asked})
    assert (error.value.path, session.t) == (path, 0)
    assert session.step((3.0, 3.0, 0.0), np.zeros(4)).t == 0


def test_a_switch_takes_no_name(small: LocalShield) -> None:
    session = small.session(initial_pose=(3.0, 3.0, 0.0))
    with pytest.raises(InputError, match="a LocalShield"):
        session.switch("case1")  # type: ignore[arg-type]
