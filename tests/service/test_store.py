"""The embedded store: durable, shared, never left behind; a store that is away; one of the operator's own."""

import asyncio
import os
import signal
import subprocess
import sys
import time

import httpx
import numpy as np
import psutil
import pytest
import redis

from specshield.errors import StoreError
from specshield.service.storage import keeper
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.store import INDEX, Change, Record, Store, keys
from tests.service.world import LOGITS, ROBOT, START, ahead, grid_json, send_policy
from tests.serving import runs, serving, wait_for
from tests.stores import store_pid


def begin(client, **options):
    client.post("/v1/maps", json=grid_json())
    body = {"policy_id": send_policy(client)["id"], "initial_pose": START, **options}
    response = client.post("/v1/sessions", json=body)
    assert response.status_code == 201, response.text
    return response.json()


def step(client, session, t, **fields):
    body = {"t": t, "poses": ahead(t)[-1:], "logits": LOGITS, **fields}
    return client.post(f"/v1/sessions/{session['id']}/steps", json=body)


def keeper_pid(data_dir):
    return psutil.Process(store_pid(data_dir)).ppid()


def test_what_was_acknowledged_survives_the_kill_of_store_and_server(tmp_path):
    with serving(tmp_path) as server, httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        session = begin(client)
        answers = [step(client, session, t).content for t in range(3)]
        os.kill(store_pid(tmp_path), signal.SIGKILL)
        wait_for(lambda: step(client, session, 3).status_code == 200)  # started again by the server
        answers.append(step(client, session, 3).content)
        pids = store_pid(tmp_path), keeper_pid(tmp_path)
        server.kill()
        wait_for(lambda: not any(map(runs, pids)))  # nothing is left behind

    with serving(tmp_path) as server, httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        assert [step(client, session, t).content for t in range(4)] == answers
        assert client.get(f"/v1/sessions/{session['id']}").json()["next_t"] == 4
        assert step(client, session, 4).status_code == 200


def test_a_session_that_looks_ahead_goes_on_at_once_after_a_restart(tmp_path):
    """Projection, which is as safe, while another process prepares: seconds, for an apartment."""
    logits = np.linspace(-2.0, 2.0, 20)
    asked = {"policy_id": "case1", "initial_pose": [4.5, 5.0, 0.0], "shaping": "lookahead"}
    with serving(tmp_path) as server, httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        session = client.post("/v1/sessions", json=asked).json()
        server.kill()
    with serving(tmp_path) as server, httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        body = {"t": 0, "poses": [asked["initial_pose"]], "logits": logits.tolist()}
        answer = client.post(f"/v1/sessions/{session['id']}/steps", json=body).json()
    moves = np.arange(20) != 4
    prior = np.exp(logits) / np.exp(logits).sum()
    kept = prior * moves * (np.array(answer["j_values"]) == 1.0)
    expected = np.where(moves, kept * (1.0 - prior[4]) / kept.sum(), prior)
    np.testing.assert_allclose(answer["distribution"], expected, atol=1e-9)


def test_the_store_ends_with_its_keeper(tmp_path):
    embedded = EmbeddedStore(tmp_path)
    embedded.join()
    pid = store_pid(tmp_path)
    os.kill(keeper_pid(tmp_path), signal.SIGKILL)
    wait_for(lambda: not runs(pid))
    assert not embedded.joined()
    embedded.join()
    assert store_pid(tmp_path) != pid
    embedded.leave()


def test_a_store_stays_until_its_last_user_is_gone(tmp_path):
    first, second = EmbeddedStore(tmp_path), EmbeddedStore(tmp_path)
    first.join()
    second.join()
    pid = store_pid(tmp_path)
    first.leave()
    time.sleep(0.3)
    assert runs(pid)
    assert second.joined()
    second.leave()
    wait_for(lambda: not runs(pid))


def test_a_store_that_nobody_wants_any_more_leaves_at_once_however_young(tmp_path):
    """The keeper ignores SIGTERM, and a store has no handler of its own in its first moments."""
    waits = [sys.executable, "-c", "import time; time.sleep(3600)"]
    done = subprocess.run([sys.executable, keeper.__file__, tmp_path, *waits], stdin=subprocess.DEVNULL)
    assert done.returncode == 128 + signal.SIGTERM  # told to stop, not killed after the keeper's patience


def test_a_folder_that_cannot_be_used_is_said_to_be(tmp_path):
    (tmp_path / "store").touch()
    with pytest.raises(StoreError, match=f"cannot be used: {tmp_path}/store: File exists"):
        EmbeddedStore(tmp_path).join()


def test_any_name_of_a_folder_will_do(tmp_path):
    """redis-py reads "%", "#" and "?" in a socket's address, and splits what a store says at " " and "="."""
    folder = tmp_path / "a b=1%20#?é"
    goal = {"type": "circle", "center": [2.0, 1.5], "radius": 0.5}
    with (
        serving(folder, SPECSHIELD_WORKER="true") as server,
        httpx.Client(base_url=server.url, verify=False, timeout=None) as client,
    ):
        map_id = client.post("/v1/maps", json=grid_json()).json()["id"]
        spec = {"formula": "F[0,6] Goal", "regions": {"Goal": goal}}
        policy = client.post("/v1/policies", json={"map_id": map_id, "robot": ROBOT, "spec": spec}).json()
        wait_for(lambda: client.get(f"/v1/policies/{policy['id']}").json()["status"] == "ready")
        assert store_pid(folder)


def test_a_path_too_long_for_a_socket_is_said_to_be(tmp_path):
    with pytest.raises(StoreError, match="too long"):
        EmbeddedStore(tmp_path / ("x" * 100))


def test_a_store_whose_file_is_spoiled_is_reported(tmp_path):
    embedded = EmbeddedStore(tmp_path)
    embedded.join()
    embedded.leave()
    (base,) = (tmp_path / "store" / "appendonlydir").glob("*.manifest")
    base.write_text("spoiled")
    with pytest.raises(StoreError, match=r"store\.log"):
        EmbeddedStore(tmp_path).join()


def test_two_servers_share_one_store_and_one_step_has_one_answer(tmp_path):
    with (
        serving(tmp_path) as one,
        serving(tmp_path) as other,
        httpx.Client(base_url=one.url, verify=False, timeout=None) as a,
        httpx.Client(base_url=other.url, verify=False, timeout=None) as b,
    ):
        session = begin(a)
        assert step(b, session, 0).content == step(a, session, 0).content
        assert b.get("/v1/sessions").json() == a.get("/v1/sessions").json()
        one.kill()  # it started the store; the other still uses it
        assert step(b, session, 1).status_code == 200


def test_a_store_that_is_away_is_said_to_be_and_nothing_hangs(tmp_path):
    dead = f"unix://{tmp_path / 'nothing'}"
    with (
        serving(tmp_path, ready=False, REDIS_URL=dead) as server,
        httpx.Client(base_url=server.url, verify=False, timeout=None) as client,
    ):
        while not alive(client) or client.get("/v1/sessions").json()["type"] == "starting":
            assert server.process.poll() is None
            time.sleep(0.05)
        for response in (client.get("/readyz"), client.get("/v1/sessions"), client.get("/v1/sessions/x")):
            assert (response.status_code, response.json()["type"]) == (503, "store-unavailable")
            assert response.headers["retry-after"] == "1"
        assert client.get("/livez").status_code == 200
    said = [line for line in server.log.read_text().splitlines() if "not ready yet" in line]
    assert len(said) == 1  # once, and not at each try
    assert "the store cannot be reached" in said[0]


def alive(client):
    try:
        return client.get("/livez").status_code == 200
    except httpx.TransportError:
        return False


def test_a_store_of_ones_own_and_sessions_that_expire(tmp_path):
    own = EmbeddedStore(tmp_path / "own")
    own.join()
    try:
        bounds = {"SPECSHIELD_MAX_SESSIONS": "1", "SPECSHIELD_MAX_STEPS": "145"}
        with serving(tmp_path / "data", REDIS_URL=own.url, SPECSHIELD_SESSION_TTL="3600", **bounds) as server:
            assert not (tmp_path / "data" / "store").exists()
            with (
                httpx.Client(base_url=server.url, verify=False, timeout=None) as client,
                redis.Redis(unix_socket_path=str(own.socket)) as connection,
            ):
                long = client.post("/v1/sessions", json={"policy_id": "case2", "initial_pose": START})
                assert (long.status_code, long.json()["path"]) == (422, "policy_id"), long.text
                assert (long.json()["got"], long.json()["expected"]) == ("step 150", "at most step 145")
                session = begin(client)
                assert session["max_steps"] == 145
                keys = connection.keys(f"specshield:*{session['id']}*")
                assert 3000 < min(map(connection.ttl, keys)) <= max(map(connection.ttl, keys)) <= 3600
                full = client.post("/v1/sessions", json={"policy_id": "case1", "initial_pose": START})
                assert (full.status_code, full.json()["type"]) == (429, "limit-reached")
                for key in keys:
                    connection.expire(key, 600)  # as if 3,000 s had passed
                assert step(client, session, 0).status_code == 200
                keys = connection.keys(f"specshield:*{session['id']}*")
                assert min(map(connection.ttl, keys)) > 3000, "a step moves the end on"
                for key in keys:
                    connection.pexpire(key, 1)  # as if the rest had passed
                path = f"/v1/sessions/{session['id']}"
                wait_for(lambda: client.get(path).status_code == 404)
                assert client.get("/v1/sessions").json() == {"items": [], "next": None}
                assert connection.keys(f"specshield:*{session['id']}*") == []
                session = begin(client)  # there is room again
                connection.config_set("maxmemory", 1)
                refused = step(client, session, 0)
                assert refused.json()["detail"].startswith("the store refuses: OOM")  # why, in its own words
                connection.config_set("maxmemory", 0)
                assert step(client, session, 0).status_code == 200
    finally:
        own.leave()


def test_an_answer_that_is_late_is_not_written_into_the_next_session_of_its_name(tmp_path):
    own = EmbeddedStore(tmp_path)
    own.join()

    async def scene():
        store = Store(own.url, timeout=5.0, ttl=60)
        change = Change(b"state", bytes(24))
        await store.create("a", b"the first", change)
        seen = await store.load("a", 0)
        assert isinstance(await store.append("a", seen.version, change), bytes)
        assert isinstance(await store.append("a", seen.version, change), Record)
        await store.redis.unlink(*keys("a"))
        await store.create("a", b"the second", change)
        there = await store.append("a", seen.version, Change(b"late", bytes(24)))
        assert (there.config, there.state) == (b"the second", b"state")
        new = await store.load("a", 0)
        assert (new.config, new.state) == (b"the second", b"state")
        assert isinstance(await store.append("a", new.version, change), bytes)
        await store.redis.unlink(*keys("a"))
        assert await store.append("a", new.version, change) is None
        await store.aclose()

    try:
        asyncio.run(scene())
    finally:
        own.leave()


def test_a_list_of_names_is_swept_once_for_all_who_wait_for_room(tmp_path):
    own = EmbeddedStore(tmp_path)
    own.join()

    async def scene():
        store = Store(own.url, timeout=5.0, ttl=60)
        await store.create("ann@here", b"config", Change(b"state", bytes(24)))
        await store.redis.zadd(INDEX, {f"ann@gone{i}": 0 for i in range(5)})
        await store.redis.config_resetstat()
        await asyncio.gather(*(store.sweep("ann") for _ in range(20)))
        read = (await store.redis.info("commandstats"))["cmdstat_zrangebylex"]["calls"]
        assert await store.count("ann") == 1
        await store.redis.zadd(INDEX, {"ann@later": 0})
        await store.sweep("ann")  # nobody else is at it, so this one looks for itself
        assert await store.count("ann") == 1
        await store.aclose()
        return read

    try:
        assert asyncio.run(scene()) <= 4  # two sweeps, each of which reads until there is no more
    finally:
        own.leave()


def test_the_key_opens_what_it_should(tmp_path):
    with (
        serving(tmp_path, SPECSHIELD_API_KEY="s3cret") as server,
        httpx.Client(base_url=server.url, verify=False, timeout=None) as client,
    ):
        for path in ("/livez", "/readyz", "/docs", "/openapi.json"):
            assert client.get(path).status_code == 200
        for given in (None, "Bearer wrong", "s3cret", "Basic s3cret", "Bearer", "Bearer s3cret s3cret"):
            headers = {} if given is None else {"Authorization": given}
            for path in ("/v1/sessions", "/metrics", "/v1/nothing"):
                response = client.get(path, headers=headers)
                assert (response.status_code, response.json()["type"]) == (401, "unauthorized")
                assert response.headers["www-authenticate"] == "Bearer"
        for scheme in ("Bearer", "bearer", "BEARER"):
            headers = {"Authorization": f"{scheme} s3cret"}
            assert client.get("/v1/sessions", headers=headers).status_code == 200


def test_a_server_that_fails_says_no_more_than_that(tmp_path):
    with serving(tmp_path) as server, httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        session = begin(client)
        with redis.Redis(unix_socket_path=str(tmp_path / "store" / "socket")) as connection:
            connection.hset(f"specshield:v2:{{@{session['id']}}}:session", "state", "broken")
        response = client.get(f"/v1/sessions/{session['id']}")
        assert (response.status_code, response.json()["type"]) == (500, "internal-error")
        assert response.headers["content-type"] == "application/problem+json"
        assert "ValidationError" not in response.text
        wait_for(lambda: "ValidationError" in server.log.read_text())
        assert client.get("/readyz").status_code == 200


def test_a_store_that_hangs_holds_nobody_longer_than_the_limit(tmp_path):
    with (
        serving(tmp_path, SPECSHIELD_STORE_TIMEOUT="0.5") as server,
        httpx.Client(base_url=server.url, verify=False, timeout=None) as client,
    ):
        session = begin(client)
        first = step(client, session, 0)
        policy = {"map_id": "case1", "spec": {"formula": "F[0,9] Office"}}
        hung = store_pid(tmp_path)
        os.kill(hung, signal.SIGSTOP)
        try:
            for ask in (
                lambda: client.get("/readyz"),
                lambda: step(client, session, 1),
                lambda: client.get("/v1/sessions"),
                lambda: client.post("/v1/policies", json=policy),
            ):
                response = ask()  # while the store hangs
                assert (response.status_code, response.json()["type"]) == (503, "store-unavailable")
        finally:
            os.kill(hung, signal.SIGCONT)
        assert step(client, session, 0).content == first.content
        assert client.get("/readyz").status_code == 200
