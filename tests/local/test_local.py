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
from specshield.errors import HistoryConflict, InfeasibleStart, InfeasibleSwitch, NotFound, SessionFinished
from specshield.local import LocalShield
from specshield.world.occupancy import OccupancyGrid
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
        while not local.finished:
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
        assert local.t > 80
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
    there, here, begins = list[str](), list[LocalShield](), (1.0, 1.5, 0.0)
    with httpx.Client(base_url=server.url, verify=False, timeout=60.0) as client:
        assert client.post("/v1/maps", json=grid_json()).status_code == 201
        for formula in ("F[0,5] x > 0.5", "F[0,20] x > 1.5"):
            spec: dict[str, Any] = {"formula": formula, "regions": {}}
            there.append(send_policy(client, spec=spec)["id"])
            parts = policy_files(spec)
            (tmp_path / "policy.safetensors").write_bytes(parts["weights"])
            (tmp_path / "card.json").write_bytes(parts["card"])
            here.append(LocalShield.load(tmp_path, grid_json()))
    with ShieldClient(server.url, timeout=60.0) as sdk:
        remote = sdk.sessions.create(policy_id=there[0], initial_pose=begins)
        local = here[0].session(initial_pose=begins)
        ending = [None, None, None, None, 0.0]
        assert local.step(begins, ending) == replace(remote.step(begins, ending), timings={})
        assert local.finished
        taken = remote.switch(there[1]), local.switch(here[1])
        assert {(each.spec_status, each.finished) for each in (*taken, local)} == {("pending", False)}
        pose = begins
        while not local.finished:
            decision = local.step(pose)
            assert decision == replace(remote.step(pose), timings={})
            pose = decision.next_poses[decision.execute]
        assert local.spec_status == "satisfied"
        for session, last in ((remote, there[0]), (local, here[0])):
            with pytest.raises(SessionFinished):
                session.switch(last)


def test_a_policy_made_on_the_spot_is_the_same_from_its_folder(tmp_path: Path) -> None:
    occupied = np.zeros((30, 40), bool)
    occupied[10:20, 15] = True
    regions = {"Dock": {"type": "circle", "center": [8.0, 6.0], "radius": 0.6}}
    made = LocalShield.make(
        OccupancyGrid(occupied, 0.25), "F[0,60] Dock and G[0,90] load < 5", regions,
        signals={"load": 0.0}, robot=ROBOT,
    )  # fmt: skip
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


def test_what_is_wrong_is_said() -> None:
    with pytest.raises(NotFound, match="case1, case1-dqn"):
        LocalShield.shipped("case9")
    shield = LocalShield.shipped("case1")
    session = shield.session(initial_pose=START)
    with pytest.raises(HistoryConflict):
        session.step((4.0, 5.0, 0.0), np.zeros(20))
    session.step((*START[:2], 2 * np.pi), np.zeros(20))
    wall = OccupancyGrid(np.repeat([[0, 0, 0, 1, 0, 0, 0]], 7, axis=0) > 0, 1.0)
    with pytest.raises(InfeasibleStart):
        LocalShield.make(wall, "F[0,60] x > 5", robot=ROBOT).session(initial_pose=(1.5, 1.5, 0.0))


def test_no_web_part_is_imported() -> None:
    code = "import specshield.local, specshield.client.models, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    web = {"httpx", "fastapi", "starlette", "pydantic", "redis", "rq", "uvicorn", "torch"}
    assert not web & set(done.stdout.split())
