"""Rows with stores of several machines, and with an archive behind the store."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import redis

from benchmarks.reliability.faults.crowd import Crowd
from benchmarks.reliability.faults.kills import Scene
from benchmarks.reliability.plant import Program, RedisServer, Service, wait_for
from tests.serving import free_port

NODES, SLOTS = 3, 16384
MOVED = 400  # slots that move to another node, each time
DOWN = 0.5  # [s] that a killed node stays away
IDLE = 2  # [s] after which a session moves to the archive
QUORUM = 2
# [ms] without an answer after which a sentinel takes a store for dead. It first pings a new master after so
# long, or after a second if that is less: with less than a second here, it may take it for dead and go back.
UNHEARD = 1200


def cluster_node(scene: Scene) -> dict[str, Any]:
    """A Redis Cluster of three nodes, one of them killed and started again after half a second."""
    with _cluster(scene.folder / "nodes") as nodes, _before(scene, nodes) as service:

        def mend(i: int) -> None:
            time.sleep(DOWN)
            nodes[i].start()

        with Crowd([service.url], scene.starts, 6) as crowd:
            for i in range(scene.n):
                node = i % NODES
                crowd.fault(nodes[node].kill, lambda node=node: mend(node))
                wait_for(lambda: all(map(_whole, nodes)), 60.0, "a whole cluster")
        return {"kills": scene.n, **crowd.result(service.url, scene.reference)}


def cluster_slots(scene: Scene) -> dict[str, Any]:
    """A Redis Cluster of three nodes; 400 slots move from one to the next while robots drive."""
    with _cluster(scene.folder / "nodes") as nodes, _before(scene, nodes) as service:
        names = [_ask(node, "CLUSTER", "MYID").decode() for node in nodes]

        def move(i: int) -> None:
            source, target = names[i % NODES], names[(i + 1) % NODES]
            moving = ["--cluster-from", source, "--cluster-to", target, "--cluster-slots", str(MOVED)]
            at = f"127.0.0.1:{nodes[0].port}"
            command = ["redis-cli", "--cluster", "reshard", at, *moving, "--cluster-yes"]
            done = subprocess.run(command, capture_output=True, text=True, timeout=120.0)
            if done.returncode:
                raise RuntimeError(done.stdout[-1000:] + done.stderr[-1000:])

        with Crowd([service.url], scene.starts, 6) as crowd:
            for i in range(scene.n):
                crowd.fault(lambda i=i: move(i))
        return {"moves": scene.n, "slots_a_move": MOVED, **crowd.result(service.url, scene.reference)}


def sentinel(scene: Scene) -> dict[str, Any]:
    """A master and a replica behind three sentinels, with `SPECSHIELD_STORE_REPLICAS=1`; the master is
    killed, the replica takes over, and the old master comes back as its replica. Nothing is answered before.
    """
    replicas = {"SPECSHIELD_STORE_REPLICAS": "1"}
    with _watched(scene.folder) as (pair, watcher, url), _served(scene, url, **replicas) as service:

        def mend(master: RedisServer, other: RedisServer) -> None:
            wait_for(lambda: _master(watcher) == other.port, 60.0, "a new master")
            master.start()
            wait_for(master.answers, 30.0, "the old master")
            # As an option of its start, --replicaof, this waits for the next of Redis's rounds, one a second.
            _ask(master, "REPLICAOF", "127.0.0.1", other.port)

        with Crowd([service.url], scene.starts, 4) as crowd:
            for _ in range(scene.n):
                master = next(node for node in pair if node.port == _master(watcher))
                other = next(node for node in pair if node is not master)
                crowd.fault(master.kill, lambda master=master, other=other: mend(master, other))
                wait_for(lambda: any(map(_follows, pair)), 60.0, "a replica again")
                wait_for(lambda: _known_replica(watcher), 60.0, "a replica that the sentinels know")
        return {"kills": scene.n, **crowd.result(service.url, scene.reference)}


def archive(scene: Scene) -> dict[str, Any]:
    """SIGKILL of a server whose sessions move to the archive after 2 s, with robots that stand still for 4 s
    now and then, whose sessions come back from it.
    """
    settings = {"SPECSHIELD_ARCHIVE_AFTER": str(IDLE)}
    with RedisServer(scene.folder / "redis") as store, _served(scene, store.url, **settings) as service:
        with Crowd([service.url], scene.starts, 6, nap=2.0 * IDLE) as crowd:
            for _ in range(scene.n):
                crowd.fault(service.kill, service.start)
        with redis.Redis(port=store.port) as found:
            wait_for(lambda: not _sessions(found), 120.0, "a store that holds no session")
            held = _sessions(found)
        result = crowd.result(service.url, scene.reference)
    return {"kills": scene.n, **result, "left_in_store": held}


def _sessions(store: redis.Redis) -> int:
    return sum(1 for _ in store.scan_iter("specshield:v2:{*}:session", count=1000))


@contextmanager
def _served(scene: Scene, url: str, **settings: str) -> Iterator[Service]:
    with Service(scene.folder / "data", REDIS_URL=url, **settings) as service:
        yield service


@contextmanager
def _before(scene: Scene, nodes: list[RedisServer]) -> Iterator[Service]:
    """A server of a cluster."""
    hosts = ",".join(f"127.0.0.1:{node.port}" for node in nodes)
    with _served(scene, f"redis+cluster://{hosts}") as service:
        yield service


@contextmanager
def _cluster(folder: Path) -> Iterator[list[RedisServer]]:
    with ExitStack() as stack:
        nodes, buses = [], [free_port() for _ in range(NODES)]
        for i, bus in enumerate(buses):
            options = [
                "--cluster-enabled",
                "yes",
                "--cluster-port",
                str(bus),
                "--cluster-node-timeout",
                "2000",
            ]
            options += ["--cluster-require-full-coverage", "no"]
            nodes.append(stack.enter_context(RedisServer(folder / str(i), *options)))
        for i, node in enumerate(nodes):
            _ask(node, "CLUSTER", "ADDSLOTSRANGE", i * SLOTS // NODES, (i + 1) * SLOTS // NODES - 1)
            _ask(node, "CLUSTER", "SET-CONFIG-EPOCH", i + 1)
        for node, bus in zip(nodes[1:], buses[1:], strict=True):
            _ask(nodes[0], "CLUSTER", "MEET", "127.0.0.1", node.port, bus)
        wait_for(lambda: all(map(_whole, nodes)), 60.0, "a whole cluster")
        yield nodes


@contextmanager
def _watched(folder: Path) -> Iterator[tuple[list[RedisServer], list[RedisServer], str]]:
    """A master with its replica, the sentinels, and the URL of it all."""
    with ExitStack() as stack:
        quick = ["--repl-diskless-sync-delay", "0"]
        pair = [stack.enter_context(RedisServer(folder / name, *quick)) for name in ("first", "second")]
        _ask(pair[1], "REPLICAOF", "127.0.0.1", pair[0].port)
        wait_for(lambda: _follows(pair[1]), 60.0, "a replica")
        watchers = []
        for i in range(3):
            watcher = RedisServer(folder / f"sentinel-{i}")
            told = watcher.folder / "sentinel.conf"
            told.write_text(
                f"port {watcher.port}\nbind 127.0.0.1\ndir {watcher.folder}\n"
                f"sentinel monitor shield 127.0.0.1 {pair[0].port} {QUORUM}\n"
                f"sentinel down-after-milliseconds shield {UNHEARD}\nsentinel failover-timeout shield 3000\n"
            )
            Program.__init__(watcher, ["redis-server", str(told), "--sentinel"], watcher.log)
            watchers.append(stack.enter_context(watcher))
        wait_for(lambda: _known_replica(watchers), 60.0, "sentinels that know the replica")
        hosts = ",".join(f"127.0.0.1:{watcher.port}" for watcher in watchers)
        yield pair, watchers, f"redis+sentinel://{hosts}/shield"


def _ask(node: RedisServer, *command: Any) -> Any:
    with redis.Redis(port=node.port, socket_timeout=5.0) as found:
        return found.execute_command(*command)


def _whole(node: RedisServer) -> bool:
    with suppress(redis.RedisError):
        told = _ask(node, "CLUSTER", "INFO")
        return b"cluster_state:ok" in told and b"cluster_slots_ok:16384" in told
    return False


def _follows(node: RedisServer) -> bool:
    with suppress(redis.RedisError), redis.Redis(port=node.port, socket_timeout=5.0) as found:
        return found.info("replication").get("master_link_status") == "up"
    return False


def _master(watchers: list[RedisServer]) -> int:
    """The port of the one that most sentinels name."""
    named = list[int]()
    for watcher in watchers:
        with suppress(redis.RedisError):
            named.append(int(_ask(watcher, "SENTINEL", "GET-MASTER-ADDR-BY-NAME", "shield")[1]))
    return max(set(named), key=named.count)


def _known_replica(watchers: list[RedisServer]) -> bool:
    """Whether every sentinel knows a replica that is there, and the other sentinels."""
    for watcher in watchers:
        with redis.Redis(port=watcher.port, socket_timeout=5.0) as found:
            try:
                replicas = found.sentinel_slaves("shield")
                others = found.sentinel_sentinels("shield")
            except redis.RedisError:
                return False
        if len(others) < len(watchers) - 1 or not any(_up(each) for each in replicas):
            return False
    return True


def _up(replica: dict[str, Any]) -> bool:
    return not replica["is_sdown"] and not replica["is_odown"] and replica.get("master-link-status") == "ok"
