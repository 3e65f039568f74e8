"""The SDK against a real server: every decision here is one the service made."""

import asyncio
import contextlib
import dataclasses
import math
import random

import httpx
import numpy as np
import pytest

from benchmarks.away import campaign
from specshield import errors
from specshield.client import AsyncShieldClient, Decision, ShieldClient

pytest.importorskip("specshield.service.app", reason="needs the service")
from specshield.service.schemas.steps import StepResponse
from specshield.sim.cases import load_case


@pytest.fixture
def client(server):
    with ShieldClient(server.url, timeout=60.0) as client:
        yield client


def poses(client, case, seed=0):
    """Poses drawn over the case's map; some are in collision, a few have no satisfying future."""
    rng = random.Random(seed)
    xmin, ymin, xmax, ymax = client.maps.get(case).bounds
    for _ in range(300):
        yield rng.uniform(xmin, xmax), rng.uniform(ymin, ymax), rng.uniform(-math.pi, math.pi)


def begin(client, case="case1", seed=0, **options):
    """A session at the first pose that is accepted, and the pose."""
    for pose in poses(client, case, seed):
        with contextlib.suppress(errors.PoseError, errors.InfeasibleStart):
            return client.sessions.create(policy_id=case, initial_pose=pose, seed=seed, **options), pose
    raise AssertionError("no start of 300 was accepted")


def model(session, seed):
    """Logits of a model that knows nothing of the rule: noise, `end` seldom."""
    noise = np.random.default_rng([seed, session.t]).normal(size=len(session.info.actions))
    noise[session.info.actions.index("end")] -= 3.0
    return noise


def drive(session, pose, seed=0):
    """The README's loop, with a robot that does exactly what f says: decisions, and the last pose."""
    decisions = []
    while not session.finished:
        decision = session.step(pose, model(session, seed))
        decisions.append(decision)
        pose = decision.next_poses[decision.execute]
    return decisions, pose


@pytest.mark.parametrize("case", ["case1", "case2"])
def test_the_loop_of_the_readme_keeps_the_rule(client, case):
    session, pose = begin(client, case)
    with session:
        decisions, _ = drive(session, pose)
    end = session.info.actions.index("end")
    assert session.closed
    assert session.spec_status == "satisfied"
    assert [decision.t for decision in decisions] == list(range(len(decisions)))
    for decision in decisions:
        assert len(decision.distribution) == len(decision.next_poses) == len(session.info.actions)
        assert math.fsum(decision.distribution) == pytest.approx(1.0)
        assert "total" in decision.timings
        if decision.spec_status == "pending":
            assert decision.execute != end
            assert decision.completion_action is not None
    client.sessions.delete(session.id)


def test_nothing_of_an_answer_is_lost(client):
    assert set(StepResponse.model_fields) <= {field.name for field in dataclasses.fields(Decision)}
    session, pose = begin(client)
    assert session.step(pose, model(session, 0)).in_collision is False
    xmin, ymin, _, _ = client.maps.get("case1").bounds
    assert session.step((xmin, ymin, 0.0), model(session, 0)).in_collision is True
    client.sessions.delete(session.id)


def test_a_caller_that_draws_its_own_actions_keeps_the_rule(client):
    session, pose = begin(client, seed=1)
    end, rng, done = session.info.actions.index("end"), random.Random(1), False
    with session:
        while not session.finished:
            decision = session.step(pose, model(session, 1), main_task_done=done)
            action = rng.choices(range(len(decision.distribution)), decision.distribution)[0]
            if action == end:
                done = True
                action = end if decision.completion_action is None else decision.completion_action
            pose = decision.next_poses[action]
    assert session.spec_status == "satisfied"


class Lossy(httpx.HTTPTransport):
    """A network that delivers every request and loses every third answer."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def handle_request(self, request):
        response = super().handle_request(request)
        self.count += 1
        if self.count % 3 == 1:
            response.read()
            response.close()
            raise httpx.ReadTimeout("lost on the way back", request=request)
        return response


def test_lost_answers_change_nothing(client, server):
    """The same decisions, bit for bit, although every third answer was lost after the server had acted."""
    session, pose = begin(client, seed=2)
    with session:
        expected, _ = drive(session, pose, seed=2)
    with (
        ShieldClient(server.url, timeout=60.0, transport=Lossy()) as lossy,
        lossy.sessions.create(policy_id="case1", initial_pose=pose, seed=2) as again,
    ):
        decisions, _ = drive(again, pose, seed=2)
    plain = [[dataclasses.replace(d, timings={}) for d in run] for run in (expected, decisions)]
    assert plain[0] == plain[1]
    assert again.spec_status == session.spec_status


def test_poses_recorded_while_the_service_was_away_arrive_with_the_next_step(client):
    session, pose = begin(client, seed=3)
    with session:
        decision = session.step(pose, model(session, 3))
        visited = [pose, decision.next_poses[decision.execute]]
        session.record(visited[1])
        session.record(visited[1])
        decision = session.step(visited[1], model(session, 3))
        assert decision.t == 3
        assert client.sessions.get(session.id).t == 4


def test_a_gap_is_filled(client):
    session, pose = begin(client, seed=3)
    with session:
        session.step(pose, model(session, 3))
        session.record(pose)
        session.record(pose)
        session._stored = 3  # as if the server had had them and lost them
        assert session.step(pose, model(session, 3)).t == 3


def test_a_session_is_read_back_and_goes_on(client):
    session, pose = begin(client, seed=4)
    decision = session.step(pose, model(session, 4), main_task_done=False)
    other = client.sessions.get(session.id)
    assert other.t == 1
    assert other.step(decision.next_poses[decision.action], model(other, 4)).t == 1
    assert client.sessions.get(session.id).close().spec_status == "pending"


def test_the_trajectory_stays_until_the_session_is_deleted(client):
    session, pose = begin(client, seed=5)
    with session:
        session.step(pose, model(session, 5))
        decision = session.step(pose, model(session, 5))
        verdict = session.close(decision.next_poses[decision.execute])
    known = session.learned()
    assert (known.t, known.map_id, known.occupied, known.free) == (1, session.info.map_id, (), ())
    items = session.trajectory()
    assert [item.t for item in items] == [0, 1, 2]
    assert items[0].pose == pytest.approx(pose)
    assert items[1].decision["action"] == decision.action
    assert items[2].decision is None
    assert verdict.spec_status == "pending"
    low, high = verdict.robustness_bounds
    assert low is None or high is None or low <= high
    assert session.id in {info.id for info in client.sessions.list()}
    client.sessions.delete(session.id)
    with pytest.raises(errors.NotFound):
        session.trajectory()


def test_problems_arrive_as_their_errors(client):
    with pytest.raises(errors.FormulaError) as caught:
        client.specs.validate("F[0,3] (a and")
    assert isinstance(caught.value.details["position"], int)
    with pytest.raises(errors.NotFound):
        client.policies.get("no-such-policy")
    session, pose = begin(client, seed=6, id=f"live-{random.getrandbits(64):x}")
    with session:
        with pytest.raises(errors.SessionExists):
            client.sessions.create(policy_id="case1", initial_pose=pose, id=session.id)
        with pytest.raises(errors.LogitsError) as caught:
            session.step(pose, [0.0, 1.0])
        assert caught.value.path == "logits"
        with pytest.raises(errors.HistoryConflict):
            session.step((pose[0] + 0.1, *pose[1:]), model(session, 6))
        assert session.step(pose, model(session, 6)).t == 0
    with pytest.raises(errors.SessionFinished):
        session.step(pose, model(session, 6))


def test_a_formula_comes_back_in_its_canonical_text(client):
    spec = client.specs.validate("eventually[0:60] (Charger1 | Charger2)")
    assert (spec.horizon, set(spec.names)) == (60, {"Charger1", "Charger2"})
    assert client.specs.validate(spec.formula) == spec


def test_maps_are_addressed_by_content(client):
    metadata = """{image: room.pgm, resolution: 0.1, origin: [1.0, 2.0, 0.0],
                   negate: 0, occupied_thresh: 0.65, free_thresh: 0.196}"""
    image = b"P5 40 30 255\n" + bytes([254]) * 1200
    uploaded = client.maps.upload(metadata, image)
    assert (uploaded.width, uploaded.height, uploaded.resolution) == (40, 30, 0.1)
    assert uploaded.bounds == pytest.approx((1.0, 2.0, 5.0, 5.0))
    assert client.maps.upload(metadata, image).id == uploaded.id
    assert client.maps.get(uploaded.id) == uploaded
    assert uploaded.id in {m.id for m in client.maps.list()}
    assert client.maps.image(uploaded.id).startswith(b"\x89PNG")
    origin = {"position": {"x": 1, "y": 2, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    info = {"resolution": 0.1, "width": 40, "height": 30, "origin": origin}
    assert client.maps.occupancy_grid(info, np.zeros(1200, dtype=np.int8)).bounds == pytest.approx(
        uploaded.bounds
    )


def test_policies_of_the_repository_are_ready(client):
    ready = {policy.id: policy for policy in client.policies.list() if policy.status == "ready"}
    assert client.policies.wait("case1", timeout=60).id in ready


def test_async_sessions_run_side_by_side(client, server):
    starts = []
    for seed in range(3):
        session, pose = begin(client, seed=seed)
        session.close()
        starts.append(pose)

    async def episode(client, pose, seed):
        async with await client.sessions.create(policy_id="case1", initial_pose=pose, seed=seed) as session:
            for _ in range(10):
                decision = await session.step(pose, model(session, seed))
                pose = decision.next_poses[decision.execute]
            return session.id, session.t

    async def main():
        async with AsyncShieldClient(server.url, timeout=60.0) as client:
            episodes = await asyncio.gather(*(episode(client, pose, i) for i, pose in enumerate(starts)))
            ids = {info.id async for info in client.sessions.list()}
            return episodes, ids

    episodes, ids = asyncio.run(main())
    assert [t for _, t in episodes] == [10, 10, 10]
    assert {id for id, _ in episodes} <= ids


@pytest.mark.parametrize("case", ["case1", "case2"])
def test_the_rule_is_kept_although_the_service_is_away_for_30_steps(server, case):
    """One episode on a network that is cut, and one on which answers are lost."""
    counts = campaign(server.url, load_case(case), episodes=2, steps=30, seed=1)
    assert counts["satisfied"] == counts["episodes"] == 2
    assert counts["steps by witness"] > 0


def test_a_session_read_back_follows_what_the_service_certified_last(client):
    session, pose = begin(client, seed=7)
    decision = session.step(pose, model(session, 7))
    pose = decision.next_poses[decision.execute]
    with ShieldClient("http://127.0.0.1:9") as nowhere:
        again = client.sessions.get(session.id, on_failure="witness")
        again._run = nowhere._run
        alone = again.step(pose, model(again, 7))
    assert (alone.source, alone.t, alone.execute) == ("witness", 1, decision.witness[0])
    client.sessions.delete(session.id)
