"""Real stores of several kinds for tests: a cluster of three, a sentinel with a replica, one behind TLS."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import redis

from tests.serving import free_port, wait_for

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


@contextmanager
def cluster(folder: Path) -> Iterator[list[int]]:
    """A cluster of three masters; their ports."""
    ports = [free_port() for _ in range(3)]
    with ExitStack() as stack:
        for port in ports:
            bus = free_port()
            options = ("--port", str(port), "--cluster-enabled", "yes", "--cluster-port", str(bus), *DURABLE)
            stack.enter_context(running(folder / str(port), *options))
        nodes = [stack.enter_context(redis.Redis(port=port)) for port in ports]
        wait_for(lambda: all(_answers(node) for node in nodes), 20.0)
        share = 16384 // 3 + 1
        for i, node in enumerate(nodes):
            last = min((i + 1) * share, 16384) - 1
            node.execute_command("CLUSTER", "ADDSLOTSRANGE", i * share, last)
            node.execute_command("CLUSTER", "SET-CONFIG-EPOCH", i + 1)
        for other in ports[1:]:
            bus = nodes[ports.index(other)].config_get("cluster-port")["cluster-port"]
            nodes[0].execute_command("CLUSTER", "MEET", "127.0.0.1", other, bus)
        wait_for(
            lambda: all(b"cluster_state:ok" in node.execute_command("CLUSTER", "INFO") for node in nodes),
            20.0,
        )
        yield ports


@dataclass
class Watched:
    """A server with a replica, and the sentinel that makes the replica the server when the first is gone."""

    url: str
    master: subprocess.Popen[bytes]
    sentinel: redis.Redis
    ports: tuple[int, int]

    def promoted(self) -> bool:
        """Whether the sentinel names the one that was the replica."""
        return int(self.sentinel.sentinel_get_master_addr_by_name("shield")[1]) == self.ports[1]


@contextmanager
def watched(folder: Path) -> Iterator[Watched]:
    first, second, port = free_port(), free_port(), free_port()
    with ExitStack() as stack:
        master = stack.enter_context(running(folder / "first", "--port", str(first), *DURABLE))
        follows = ("--replicaof", f"127.0.0.1 {first}", "--repl-diskless-sync-delay", "0")
        stack.enter_context(running(folder / "second", "--port", str(second), *follows, *DURABLE))
        replica = stack.enter_context(redis.Redis(port=second))
        wait_for(lambda: _answers(replica) and replica.info()["master_link_status"] == "up", 20.0)
        told = folder / "sentinel.conf"
        told.write_text(
            f"port {port}\nsentinel monitor shield 127.0.0.1 {first} 1\n"
            "sentinel down-after-milliseconds shield 300\nsentinel failover-timeout shield 2000\n"
        )
        stack.enter_context(running(folder, str(told), "--sentinel"))
        sentinel = stack.enter_context(redis.Redis(port=port))
        wait_for(lambda: _answers(sentinel) and sentinel.sentinel_slaves("shield"), 20.0)
        yield Watched(f"redis+sentinel://127.0.0.1:{port}/shield", master, sentinel, (first, second))


@contextmanager
def behind_tls(folder: Path) -> Iterator[str]:
    """A server that takes TLS alone, with a certificate of a made-up authority; its URL."""
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
    with running(folder, *options):
        url = f"rediss://127.0.0.1:{port}/0?ssl_ca_certs={folder / 'ca.pem'}"
        node = redis.Redis.from_url(url)
        wait_for(lambda: _answers(node), 20.0)
        yield url


def _answers(node: redis.Redis) -> bool:
    try:
        return bool(node.ping())
    except redis.ConnectionError:
        return False
