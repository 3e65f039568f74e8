"""Rules that only the planner takes, and those that look at the first state alone, over HTTP: asked for, made
by a worker, kept.
"""

from __future__ import annotations

import random

import httpx
import pytest

from specshield.client import ShieldClient
from specshield.errors import InfeasibleStart
from tests.service.world import ROBOT, START, grid_json
from tests.serving import HUNG, serving

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


def make(server, client, formula, regions=None, signals=None, method="planner"):
    map_id = httpx.post(f"{server.url}/v1/maps", json=grid_json(), timeout=None, verify=False).json()["id"]
    policy = client.policies.create(map_id, formula, regions, signals=signals, robot=ROBOT, method=method)
    return client.policies.wait(policy.id, timeout=HUNG, interval=0.1)


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
            assert (
                httpx.get(f"{server.url}/v1/sessions/{session.id}", timeout=None, verify=False).json()[
                    "any_signal"
                ]
                is True
            )
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


@pytest.mark.parametrize("formula", ["Safe and not x < 0.5", "G[0,0] y > 0.1"])
def test_a_rule_that_looks_at_the_first_state_alone(server, client, formula):
    """Its policy has nothing to propose; what keeps it at the start keeps it for ever."""
    policy = make(server, client, formula, {"Safe": SAFE} if "Safe" in formula else {}, method="reachability")
    assert policy.status == "ready", policy.error
    longer = make(server, client, "F[0,9] Safe", {"Safe": SAFE}, method="reachability")
    inside, logits = (2.0, 1.5, 0.0), [1.0, 0.0, 0.5, -1.0, None]
    with client.sessions.create(policy_id=policy.id, initial_pose=inside) as session:
        decision = session.step(inside, logits, explain=True)
        assert (decision.mode, decision.spec_status) == ("prior", "satisfied")
        assert (
            b"<svg"
            in httpx.get(
                f"{server.url}/v1/sessions/{session.id}/image.svg", timeout=None, verify=False
            ).content
        )
        pose = decision.next_poses[decision.execute]
        session.switch(policy_id=longer.id, clock="restart")
        pose = session.step(pose, logits).next_poses[0]
        session.switch(policy_id=policy.id, clock="restart")
        assert session.step(pose, logits).spec_status == "satisfied"
    picture = httpx.get(f"{server.url}/v1/policies/{policy.id}/image.svg", timeout=None, verify=False)
    assert picture.status_code == 200
    if "Safe" in formula:
        with pytest.raises(InfeasibleStart):
            client.sessions.create(policy_id=policy.id, initial_pose=START)
        with client.sessions.create(
            policy_id=policy.id, initial_pose=START, allow_infeasible=True
        ) as session:
            decision = session.step(tuple(START), logits, explain=True)
            assert (decision.mode, decision.spec_status) == ("prior", "violated")
