"""Rules that only the planner takes, over HTTP: asked for, made by a worker, kept."""

from __future__ import annotations

import random

import httpx
import pytest

from specshield.client import ShieldClient
from specshield.errors import InfeasibleStart
from tests.service.world import ROBOT, START, grid_json
from tests.serving import serving

WITHIN, UNTIL = 30, 45  # steps
SAFE = {"type": "circle", "center": [2.0, 1.5], "radius": 0.5}


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("rules"), SPECSHIELD_WORKER="true") as server:
        yield server


@pytest.fixture
def client(server):
    with ShieldClient(server.url, timeout=120.0) as client:
        yield client


def make(server, client, formula, regions, signals=None):
    map_id = httpx.post(f"{server.url}/v1/maps", json=grid_json()).json()["id"]
    policy = client.policies.create(map_id, formula, regions, signals=signals, robot=ROBOT, method="planner")
    return client.policies.wait(policy.id, timeout=300.0, interval=0.1)


def is_safe(pose):
    return (pose[0] - 2.0) ** 2 + (pose[1] - 1.5) ** 2 < 0.5**2


def test_whenever_the_event_rises_the_robot_is_soon_safe(server, client):
    """It rises at a random step, falls once the robot is in Safe, and rises again. The model is noise."""
    formula = f"G[0,{UNTIL}] (event > 0.5 -> F[0,{WITHIN}] Safe)"
    policy = make(server, client, formula, {"Safe": SAFE}, {"event": 0.0})
    # Safe is within reach of nearly all of the room; what holds whatever comes, holds also if nothing does.
    assert 1.0 >= policy.metrics["feasible_start"] >= policy.metrics["feasible_start_any_signal"] > 0.9
    assert client.policies.get(policy.id).status == "ready"
    chance = random.Random(4)
    for seed in range(3):
        pose, events, safe, event = tuple(START), [], [], 0.0
        rise = chance.randrange(5, 20)
        with client.sessions.create(policy_id=policy.id, initial_pose=pose, seed=seed) as session:
            for t in range(UNTIL + WITHIN):
                safe.append(is_safe(pose))
                if event and safe[-1]:
                    event, rise = 0.0, t + chance.randrange(2, 10)
                elif t == rise:
                    event = 1.0
                events.append(event)
                logits = [chance.gauss(1.0, 1.0), *(chance.gauss(0.0, 2.0) for _ in range(3)), None]
                decision = session.step(pose, logits, signals={"event": event})
                assert decision.reason is None
                assert decision.any_signal, "so it was promised at the start"
                pose = decision.next_poses[decision.execute]
            assert httpx.get(f"{server.url}/v1/sessions/{session.id}").json()["any_signal"] is True
            safe.append(is_safe(pose))
            assert session.close(pose).spec_status == "satisfied"
        risen = [t for t in range(UNTIL + 1) if events[t] > 0.5]
        assert risen
        assert all(any(safe[t : t + WITHIN + 1]) for t in risen)


def test_where_no_way_can_be_found_the_start_is_refused(server, client):
    regions = {"Safe": SAFE, "Far": {"type": "circle", "center": [3.5, 0.5], "radius": 0.3}}
    policy = make(server, client, "Safe U[0,9] Far or F[0,2] G[0,3] Far", regions)
    with pytest.raises(InfeasibleStart):
        client.sessions.create(policy_id=policy.id, initial_pose=START)
