"""The service on stores that others run: a cluster, one behind TLS, one that sentinels watch."""

from __future__ import annotations

import asyncio
import gc
import json
import os
import signal
import socket
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from threading import Thread
from typing import Any

import httpx
import numpy as np
import pytest
import redis
from redis.crc import key_slot

from specshield.errors import StoreError
from specshield.service.storage.connect import connect
from specshield.service.storage.store import Change, Record, Store
from tests.service.test_events import END, read
from tests.service.world import ROBOT, SPEC, grid_json, send_policy
from tests.serving import HUNG, RunningServer, run_specshield, serving, wait_for
from tests.stores import VALKEY, Cluster, behind_tls, cluster, needs_redis, watched

pytestmark = needs_redis
POSE = [4.5, 5.0, 0.0]
FIRST = 16384 // 3  # slots of the cluster's first master, whose replica takes over
STEPS = 12


@pytest.mark.parametrize("url", ["rediss+cluster://h1,h2", "rediss+sentinel://h1/service", "rediss://h1"])
def test_options_are_numbers_and_booleans_where_redis_py_wants_them(url):
    told = f"{url}?ssl_check_hostname=false&health_check_interval=10&ssl_ca_certs=/a%20b"
    made = connect(told.replace("//", "//user:p%40ss@"))
    options = made.connection_kwargs if "cluster" in url else made.connection_pool.connection_kwargs
    assert (options["username"], options["password"], options["ssl_ca_certs"]) == ("user", "p@ss", "/a b")
    assert (options["ssl_check_hostname"], options["health_check_interval"]) == (False, 10)


@contextmanager
def on_store(folder: Any, url: str, **settings: str) -> Iterator[RunningServer]:
    """A server with a worker. What ends moves to the archive a second later."""
    environment = {"REDIS_URL": url, "SPECSHIELD_WORKER": "true", "SPECSHIELD_ARCHIVE_AFTER": "1", **settings}
    with serving(folder / "data", **environment) as server:
        yield server


def key_of(name: str, folder: Any, url: str) -> str:
    """`specshield keys create`."""
    own = {"REDIS_URL": url, "SPECSHIELD_DATA_DIR": str(folder / "data")}
    done = run_specshield("keys", "create", name, **own)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


class Patient(httpx.HTTPTransport):
    """Asks again while the store is said to be away, as a robot does. After a failover each of the server's
    connections may be one to the old master.
    """

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        deadline = time.monotonic() + HUNG
        while (answer := super().handle_request(request)).status_code == 503 and time.monotonic() < deadline:
            answer.close()
            time.sleep(0.1)
        return answer


def caller(server: RunningServer, key: str) -> httpx.Client:
    told, patient = {"Authorization": f"Bearer {key}"}, Patient(verify=False)
    return httpx.Client(base_url=server.url, timeout=None, transport=patient, headers=told)


class Episode:
    """A robot of case 1 that drives as it is told, and keeps every answer."""

    def __init__(self, client: httpx.Client, id: str) -> None:
        self.client, self.id, self.path = client, id, f"/v1/sessions/{id}"
        self.pose, self.random = POSE, np.random.default_rng(7)
        self.sent: list[tuple[dict[str, Any], bytes]] = []
        body = {"policy_id": "case1", "initial_pose": POSE, "seed": 7, "id": id}
        begun = client.post("/v1/sessions", json=body)
        assert begun.status_code == 201, begun.text

    def drive(self, steps: int) -> None:
        for t in range(len(self.sent), len(self.sent) + steps):
            body = {"t": t, "poses": [self.pose], "logits": self.random.normal(size=20).tolist()}
            answer = self.ask(body)
            self.sent.append((body, answer))
            told = json.loads(answer)
            act = told["action"] if told["action"] != 4 else told["completion_action"]
            self.pose = self.pose if act is None else told["next_poses"][act]

    def ask(self, body: dict[str, Any]) -> bytes:
        response = self.client.post(f"{self.path}/steps", json=body)
        assert response.status_code == 200, response.text
        return response.content

    def is_kept(self) -> None:
        """Every answer is there, and comes again byte for byte."""
        session = self.client.get(self.path)
        assert session.json()["next_t"] == len(self.sent), session.text
        for body, answer in self.sent:
            assert self.ask(body) == answer

    def told(self, server: RunningServer) -> list[Any]:
        key = self.client.headers["Authorization"]
        return read(server.url, self.id, after=-1, headers={"Authorization": key})

    def in_archive(self, server: RunningServer) -> bool:
        return any(
            self.id in str(path) for path in (server.data_dir / "archive").rglob("*") if path.is_file()
        )


def erase(client: httpx.Client, path: str) -> None:
    answer = client.delete(path)
    assert answer.status_code == 204, answer.text


def a_whole_life(server: RunningServer, folder: Any, url: str, fail: Any = None) -> None:
    """Keys, an episode, an upload, a policy made by a worker; `fail` in between."""
    alice, bob = (caller(server, key_of(name, folder, url)) for name in ("alice", "bob"))
    ids = (f"robot-{i}" for i in range(10_000))  # one whose keys, and alice's index, the first master has
    episode = Episode(alice, next(id for id in ids if key_slot(f"alice@{id}".encode()) < FIRST))
    episode.drive(STEPS // 2)
    policies = a_library(alice, bob)
    if fail is not None:
        fail()
    episode.is_kept()
    episode.drive(STEPS - STEPS // 2)
    assert bob.get(episode.path).status_code == 404
    assert [each["id"] for each in alice.get("/v1/sessions").json()["items"]] == [episode.id]
    closed = alice.post(f"{episode.path}/close", json={})
    assert closed.status_code == 200, closed.text
    wait_for(lambda: episode.in_archive(server))
    episode.is_kept()
    assert [each["id"] for each in alice.get("/v1/sessions").json()["items"]] == [episode.id]
    told = episode.told(server)
    assert [data.encode() for _, data in told[:-1]] == [answer for _, answer in episode.sent]
    assert told[-1][0] == END
    items = alice.get(f"{episode.path}/trajectory").json()["items"]
    assert [item["t"] for item in items if item["decision"]] == [*range(STEPS)]
    erase(alice, episode.path)
    assert alice.get(episode.path).status_code == 404
    for policy in policies:  # what was made before the failure goes, and is forgotten
        erase(alice, f"/v1/policies/{policy['id']}")
    erase(alice, f"/v1/maps/{policies[0]['map_id']}")
    # On a busy machine the store may answer one scrape too late.
    wait_for(lambda: "specshield_store_up 1.0" in alice.get("/metrics").text)


def a_library(alice: httpx.Client, bob: httpx.Client) -> list[dict[str, Any]]:
    """A policy that alice sends, and one that a worker makes for her."""
    map_id = alice.post("/v1/maps", json=grid_json()).json()["id"]
    assert bob.get(f"/v1/maps/{map_id}").status_code == 404
    sent = send_policy(alice)
    body = {"map_id": map_id, "robot": ROBOT, "spec": SPEC, "method": "reachability"}
    asked = alice.post("/v1/policies", json=body)  # again while no worker has come yet
    assert asked.status_code == 202, asked.text
    made = asked.json()

    def status() -> str:
        return str(alice.get(f"/v1/policies/{made['id']}").json()["status"])

    wait_for(lambda: status() in ("ready", "failed"))
    assert status() == "ready", alice.get(f"/v1/policies/{made['id']}").text
    assert alice.delete(f"/v1/maps/{map_id}").status_code == 409
    return [sent, made]


def test_a_life_on_a_cluster_one_of_whose_masters_is_killed(tmp_path):
    with cluster(tmp_path / "store") as nodes, on_store(tmp_path, nodes.url) as server:
        a_whole_life(server, tmp_path, nodes.url, nodes.fail)


def test_a_life_under_sentinels_that_name_another_server(tmp_path):
    with watched(tmp_path / "store") as servers, on_store(tmp_path, servers.url) as server:
        a_whole_life(server, tmp_path, servers.url, servers.fail)


def test_a_life_behind_tls(tmp_path):
    with behind_tls(tmp_path / "store") as url, on_store(tmp_path, url) as server:
        a_whole_life(server, tmp_path, url)


def test_a_sentinel_that_is_gone_is_asked_once_and_then_the_next(tmp_path):
    """Else the seconds in which redis-py asks it again would be more than the service waits for the store."""
    asked = 0

    def close_each() -> None:
        nonlocal asked
        with suppress(OSError):  # the end of the block has closed the socket
            while True:
                link, _ = gone.accept()
                asked += 1  # before the client can notice the end
                link.close()

    async def ping(url: str) -> None:
        store = Store(url, timeout=60.0, ttl=60)
        await store.ping()
        await store.aclose()

    with watched(tmp_path) as there, socket.create_server(("127.0.0.1", 0)) as gone:
        Thread(target=close_each, daemon=True).start()
        url = there.url.replace("//", f"//127.0.0.1:{gone.getsockname()[1]},")
        with connect(url, blocking=True, socket_timeout=60.0) as store:
            assert store.ping()
            limits = store.connection_pool.sentinel_manager.sentinels[0].connection_pool.connection_kwargs
        assert asked == 1
        asyncio.run(ping(url))
        assert asked == 2
    names = ("socket_timeout", "socket_connect_timeout")
    assert [limits[name] for name in names] == [20.0, 20.0]  # of 60 s, for two sentinels and the store


async def refused(call: Callable[[], Awaitable[object]]) -> None:
    """Asks until the reason is that no replica answers: on a busy machine the store itself may be late."""
    for _ in range(30):
        with pytest.raises(StoreError) as error:
            await call()
        if "TimeoutError" not in str(error.value):
            break
    assert "0 of 1 replicas" in str(error.value)


@pytest.mark.parametrize("kind", [watched, partial(watched, program=VALKEY), cluster])
def test_what_its_replica_does_not_have_is_not_told(tmp_path, kind):
    """With SPECSHIELD_STORE_REPLICAS=1, whoever wrote it. It is told later, to whoever asks again."""

    async def scene(url: str, replica: int) -> None:
        store, soon, other = (
            Store(url, timeout=60.0, ttl=60, replicas=1),
            Store(url, timeout=1.0, ttl=60, replicas=1),
            Store(url, timeout=60.0, ttl=60),
        )
        id = next(id for id in map(str, range(1000)) if key_slot(id.encode()) < FIRST)
        await store.create(id, b"config", Change(b"state", bytes(24)))
        seen = await store.load(id, 0)
        assert isinstance(seen, Record)
        step = Change(b"state", bytes(24), 24, 0, b"what the step left")
        os.kill(replica, signal.SIGSTOP)
        try:
            assert isinstance(await other.append(id, seen.version, step), bytes)
            await refused(lambda: soon.load(id, 0))
            if kind is not cluster:
                await refused(soon.ping)
            await refused(soon.follow)
            await refused(lambda: soon.append(id, seen.version, step))
        finally:
            os.kill(replica, signal.SIGCONT)
        while True:
            try:
                found = await store.append(id, seen.version, step)
                break
            except StoreError:
                await asyncio.sleep(0.05)
        assert isinstance(found, Record)
        assert found.step == b"what the step left"
        if kind is not cluster:  # the other masters of the cluster have no replica
            await store.follow()
        for each in (store, soon, other):
            await each.aclose()

    with kind(tmp_path) as there:
        replica = there.replica if kind is not cluster else there.nodes[3]
        asyncio.run(scene(there.url, replica.info("server")["process_id"]))


def test_a_connection_that_is_closed_while_it_is_in_use_is_a_store_that_cannot_be_reached(tmp_path):
    """As redis-py closes all connections of a cluster when it looks for its nodes anew."""

    async def scenario(url: str) -> None:
        client = connect(url)
        await client.set("there", 1)
        node = client.get_node_from_key("there")
        held = node.acquire_connection()
        await held.disconnect()
        usual = held.connect_check_health

        async def closed_beside(check_health: bool = True) -> None:
            await usual(check_health=check_health)
            held._writer = None

        held.connect_check_health = closed_beside
        node._free.appendleft(held)
        with pytest.raises(redis.ConnectionError, match="closed while it was in use"):
            await client.get("there")
        held.connect_check_health = usual
        assert await client.get("there") == b"1"
        await client.aclose()

    with cluster(tmp_path / "store") as nodes:
        asyncio.run(scenario(nodes.url))


def test_a_session_goes_with_its_slot_to_another_node(tmp_path):
    """Appends while its keys are on their way, and later, are all there; then redis-py is asked no more."""

    async def scene(nodes: list[redis.Redis], url: str) -> None:
        store = Store(url, timeout=5.0, ttl=60)
        id = next(id for id in map(str, range(1000)) if key_slot(id.encode()) < FIRST)
        slot, (one, other) = key_slot(id.encode()), nodes[:2]
        version = await store.create(id, b"config", Change(b"state", bytes(24)))
        steps = iter(range(100))

        async def append() -> None:
            nonlocal version
            t = next(steps)
            added = await store.append(id, version, Change(b"state", bytes(24), 24 * (t + 1), t, b"%d" % t))
            assert isinstance(added, bytes)
            version = added

        await append()
        names = [node.execute_command("CLUSTER", "MYID").decode() for node in (one, other)]
        other.execute_command("CLUSTER", "SETSLOT", slot, "IMPORTING", names[0])
        one.execute_command("CLUSTER", "SETSLOT", slot, "MIGRATING", names[1])
        await append()
        held = one.execute_command("CLUSTER", "GETKEYSINSLOT", slot, 10)
        port = other.connection_pool.connection_kwargs["port"]
        assert len(held) == 3
        one.execute_command("MIGRATE", "127.0.0.1", port, "", 0, 5000, "KEYS", *held)
        await append()
        for node in (other, one, *nodes[2:3]):
            node.execute_command("CLUSTER", "SETSLOT", slot, "NODE", names[1])
        await append()
        sent_on, store.redis.eval = store.redis.eval, None
        await append()
        store.redis.eval = sent_on
        found = await store.dump(id)
        assert found is not None
        assert found.steps == [b"0", b"1", b"2", b"3", b"4"]
        await store.aclose()

    with cluster(tmp_path / "store") as there:
        asyncio.run(scene(there.nodes, there.url))


def test_a_replica_that_took_over_from_a_node_that_only_fell_silent_is_found(tmp_path):
    """As one whose machine has lost its network: no connection to it ends, and nobody is refused one."""

    async def scene(there: Cluster) -> None:
        surely = Store(there.url, 60.0, ttl=60, replicas=1)
        store, leaving = (Store(there.url, timeout=0.5, ttl=60) for _ in range(2))
        asyncio.get_running_loop().set_exception_handler(lambda _, about: noise.append(about))
        id = next(id for id in map(str, range(1000)) if key_slot(id.encode()) < FIRST)
        version = await surely.create(id, b"config", Change(b"state", bytes(24)))
        for each in (store, leaving):
            assert await each.load(id) is not None
        there.first.send_signal(signal.SIGSTOP)
        for each in (store, leaving):
            with pytest.raises(StoreError, match="TimeoutError"):
                await each.load(id)
        await leaving.aclose()  # while it still asks which node has which keys
        await asyncio.to_thread(wait_for, there.promoted)
        async with asyncio.timeout(60.0):
            while True:
                with suppress(StoreError):
                    found = await store.load(id)
                    break
        assert found is not None
        assert found.version == version
        await store.aclose()
        await surely.aclose()

    noise = list[Any]()
    with cluster(tmp_path / "store") as there:
        asyncio.run(scene(there))
    gc.collect()
    assert noise == []


def test_a_node_that_serves_nothing_for_now_is_told_at_once(tmp_path):
    """As one that is just back, for two seconds: redis-py, which waits and asks again, is not asked."""

    async def scene(node: redis.Redis, url: str) -> None:
        store = Store(url, timeout=60.0, ttl=60)
        id = next(id for id in map(str, range(1000)) if key_slot(id.encode()) < FIRST)
        slot = key_slot(id.encode())
        await store.create(id, b"config", Change(b"state", bytes(24)))
        store.redis.eval = None
        node.execute_command("CLUSTER", "DELSLOTS", slot)
        with pytest.raises(StoreError, match="CLUSTERDOWN"):
            await store.load(id)
        node.execute_command("CLUSTER", "ADDSLOTS", slot)
        assert await store.load(id) is not None
        await store.aclose()

    with cluster(tmp_path / "store") as there:
        asyncio.run(scene(there.nodes[0], there.url))


def test_a_server_that_starts_while_a_master_is_gone_for_good_serves_what_the_others_have(tmp_path):
    """Though it is the first one, which redis-py asks what commands there are."""

    async def scene(url: str) -> None:
        store = connect(url, socket_timeout=60.0)
        name = next(name for name in map(str, range(1000)) if key_slot(name.encode()) > 2 * FIRST)
        await store.set(name, 1)
        assert await store.get(name) == b"1"
        await store.aclose()

    with cluster(tmp_path / "store") as there:
        for node in there.nodes[1:3]:
            node.config_set("cluster-require-full-coverage", "no")
        os.kill(there.nodes[3].info("server")["process_id"], signal.SIGKILL)
        there.first.kill()
        asyncio.run(scene(there.url))


def test_a_cluster_that_is_away_is_said_to_be(tmp_path):
    away = "redis+cluster://127.0.0.1:1"
    with (
        serving(tmp_path, ready=False, REDIS_URL=away, SPECSHIELD_STORE_TIMEOUT="0.5") as server,
        httpx.Client(base_url=server.url, verify=False, timeout=None) as client,
    ):

        def said() -> Any:
            assert server.process.poll() is None, server.log.read_text()
            try:
                return client.get("/readyz").json()["type"]
            except httpx.TransportError:
                return None

        wait_for(lambda: said() == "store-unavailable")
        for path in ("/v1/sessions", "/v1/sessions/x", "/v1/maps", "/v1/policies"):
            response = client.get(path)
            assert (response.status_code, response.json()["type"]) == (503, "store-unavailable"), path
        assert "Traceback" not in server.log.read_text()


def test_one_master_of_a_cluster_that_is_away_is_not_taken_for_the_store(tmp_path):
    """The robots whose sessions the other masters have go on, and /readyz keeps their server in use."""

    def up(client: httpx.Client) -> list[float]:
        lines = client.get("/metrics").text.splitlines()
        return [float(line.split()[1]) for line in lines if line.startswith("specshield_store_up ")]

    with cluster(tmp_path / "store") as nodes, on_store(tmp_path, nodes.url) as server:
        client = httpx.Client(base_url=server.url, timeout=HUNG)
        wait_for(lambda: up(client) == [1.0])  # on a busy machine it may be late once
        for node, left in zip(nodes.nodes[:3], (2 / 3, 1 / 3, 0.0), strict=True):
            node.shutdown(nosave=True)
            wait_for(partial(lambda left: up(client) == [pytest.approx(left)], left))
            assert client.get("/readyz").status_code == (200 if left else 503)
