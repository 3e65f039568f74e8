"""Steps over a WebSocket, and a session that is watched, against a real server."""

import asyncio
import dataclasses
import threading

import httpx
import pytest
from test_live import begin, drive, model

from specshield import errors
from specshield.client import AsyncShieldClient, ShieldClient
from tests.service.test_keys import on_keys
from tests.service.world import grid_json, send_policy
from tests.serving import HUNG, free_port, serving, wait_for

POSE = (4.5, 5.0, 0.0)


@pytest.fixture(scope="module")
def keyed(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("keyed") / "data", SPECSHIELD_API_KEY="operator") as running:
        yield running


@pytest.mark.parametrize("ends", ["close", "delete"])
@pytest.mark.parametrize("asynchronous", [False, True])
def test_a_session_that_is_over_keeps_no_connection(server, ends, asynchronous):
    """Whoever drives many episodes with one client would run out of files."""

    async def awaited():
        async with AsyncShieldClient(server.url, timeout=60.0, stream=True) as client:
            session = await client.sessions.create(policy_id="case1", initial_pose=POSE)
            await session.step(POSE, [0.0] * 20)
            opened = len(client._streams._open)
            await (session.close() if ends == "close" else client.sessions.delete(session.id))
            return opened, len(client._streams._open)

    def blocking():
        with ShieldClient(server.url, timeout=60.0, stream=True) as client:
            session = client.sessions.create(policy_id="case1", initial_pose=POSE)
            session.step(POSE, [0.0] * 20)
            opened = len(client._streams._open)
            _ = session.close() if ends == "close" else client.sessions.delete(session.id)
            return opened, len(client._streams._open)

    assert (asyncio.run(awaited()) if asynchronous else blocking()) == (1, 0)


class Watcher(threading.Thread):
    """Reads the decisions of a session until it ends."""

    def __init__(self, url, id, after=-1, api_key=None):
        super().__init__(daemon=True)
        self.url, self.id, self.after, self.api_key, self.found = url, id, after, api_key, []
        self.start()

    def run(self):
        with ShieldClient(self.url, self.api_key, timeout=60.0) as client:
            for decision in client.sessions.get(self.id).events(self.after):
                self.found.append(decision)

    def joined(self):
        self.join(HUNG)
        assert not self.is_alive()
        return self.found


def plain(decisions):
    return [dataclasses.replace(decision, timings={}) for decision in decisions]


def test_an_episode_over_a_stream_gives_the_answers_of_http_and_its_watchers_the_same(server):
    with (
        ShieldClient(server.url, timeout=60.0) as client,
        ShieldClient(server.url, timeout=60.0, stream=True) as streaming,
    ):
        session, pose = begin(client, seed=8)
        with session:
            expected, _ = drive(session, pose, seed=8)
        twin = streaming.sessions.create(policy_id="case1", initial_pose=pose, seed=8)
        watchers = [Watcher(server.url, twin.id), Watcher(server.url, twin.id, after=4)]
        decisions, _ = drive(twin, pose, seed=8)
        assert len(streaming._streams._open) == 1
        twin.close()  # else it waits for more where the model's end was drawn after the rule was settled
        assert all("total" in decision.timings for decision in expected)
        assert plain(decisions) == plain(expected)
        assert watchers[0].joined() == plain(expected)
        assert watchers[1].joined() == plain(expected)[5:]
        assert list(client.sessions.get(twin.id).events()) == [], "over: nothing follows"

        async def again():
            async with AsyncShieldClient(server.url, timeout=60.0) as other:
                return [decision async for decision in (await other.sessions.get(twin.id)).events(-1)]

        assert asyncio.run(again()) == plain(expected)
        client.sessions.delete(twin.id)
        with pytest.raises(errors.NotFound):
            next(twin.events(-1))


def test_one_client_watches_many_sessions_and_still_steps(server):
    with ShieldClient(server.url, timeout=60.0) as client:
        session, pose = begin(client, seed=9)
        first = session.step(pose, model(session, 9))
        watching = [session.events(-1) for _ in range(12)]
        assert [next(events) for events in watching] == plain([first]) * 12
        assert session.step(first.next_poses[first.execute], model(session, 9)).t == 1
        for events in watching:
            events.close()
        wait_for(
            lambda: (
                "specshield_watchers 0.0"
                in httpx.get(f"{server.url}/metrics", timeout=None, verify=False).text
            )
        )
        client.sessions.delete(session.id)


def test_a_map_that_nobody_uses_is_deleted(server):
    with (
        ShieldClient(server.url, timeout=60.0) as client,
        httpx.Client(base_url=server.url, verify=False, timeout=60.0) as raw,
    ):
        used = raw.post("/v1/maps", json=grid_json()).json()["id"]
        send_policy(raw)
        with pytest.raises(errors.InUse):
            client.maps.delete(used)
        other = grid_json()
        other["data"][0] = 0 if other["data"][0] else 100
        map = raw.post("/v1/maps", json=other).json()["id"]
        client.maps.delete(map)
        with pytest.raises(errors.NotFound):
            client.maps.get(map)


def test_refusals_over_a_stream_are_those_of_http(keyed):
    told = []
    for stream in (False, True):
        slow = on_keys(keyed, lambda keys, name=f"slow-{stream}": keys.create(name, requests=0.01))
        with ShieldClient(keyed.url, "operator", timeout=60.0) as operator:
            session = operator.sessions.create(policy_id="case1", initial_pose=POSE)
        with ShieldClient(keyed.url, "wrong", timeout=60.0, stream=stream) as client:
            session._run = client._run
            with pytest.raises(errors.Unauthorized):
                session.step(POSE, model(session, 0))
        with ShieldClient(keyed.url, slow, timeout=60.0, stream=stream) as client:
            session._run = client._run
            for _ in range(2):  # another's session, and then too many requests
                with pytest.raises(errors.SpecshieldError) as caught:
                    session.step(POSE, model(session, 0))
                told.append((type(caught.value), caught.value.details["status"]))
    assert told == [(errors.NotFound, 404), (errors.RateLimited, 429)] * 2


def test_a_rate_limit_in_a_stream_is_that_of_http(keyed):
    with ShieldClient(keyed.url, "operator", timeout=60.0, stream=True) as client:
        session = client.sessions.create(policy_id="case1", initial_pose=POSE)
        assert session.step(POSE, model(session, 0)).t == 0
    key = on_keys(keyed, lambda keys: keys.create("few", requests=2.0))
    with ShieldClient(keyed.url, key, timeout=60.0, stream=True) as client:
        session = client.sessions.create(policy_id="case1", initial_pose=POSE)
        while not limited(lambda: client.sessions.get(session.id)):
            pass
        session.step(POSE, model(session, 0))  # whatever else the key is used for, its robots go on
        while not limited(lambda: session.step(POSE, model(session, 0))):
            pass
        t = session.t
        wait_for(lambda: not limited(lambda: session.step(POSE, model(session, 0))))
        assert (session.t, len(client._streams._open)) == (t + 1, 1)


def limited(ask):
    try:
        ask()
    except errors.RateLimited as error:
        return error.details["retry_after"] == 1
    return False


def test_a_server_that_comes_back_is_found_again_by_its_robots_and_their_watchers(tmp_path):
    port, decisions, found = free_port(), [], []
    with (
        ShieldClient(f"http://127.0.0.1:{port}", timeout=60.0, stream=True) as client,
        ShieldClient(f"http://127.0.0.1:{port}", timeout=60.0) as other,
    ):
        for last in (2, 4):
            with serving(tmp_path, port=port) as server:
                if not decisions:
                    session = client.sessions.create(policy_id="case1", initial_pose=POSE, seed=1)
                    watcher = Watcher(server.url, session.id)
                    found = watcher.found
                while session.t <= last:
                    decisions.append(session.step(POSE, model(session, 1)))
                if last == 4:
                    other.sessions.get(session.id).close()
                    assert watcher.joined() == plain(decisions)
                else:
                    wait_for(lambda seen=found: len(seen) == 3)
                    server.kill()
