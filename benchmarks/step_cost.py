"""What a step costs the whole service, beside a bare FastAPI route that takes and gives the same bodies.

    python -m benchmarks.step_cost --robots 1 16 64 --steps 100 --seed 0

Robots of case 1 drive as they are told (`next_poses[execute]`), each one step after another. For HTTP with
JSON, HTTP with MessagePack and the WebSocket with MessagePack: CPU time of server and store a step, and of
the store alone [us, user and system, of the processes, from when all sessions have begun], p50 and p99 as
the robots wait [ms], bytes sent and received with their heads.
With `--ways session` a step is to begin a session and to close it. The bare route validates the same body by
the same pydantic schema, and answers the JSON of a step, under the same uvicorn. Both are asked by the same
client in another process. CPU time is what to compare: others may use the machine.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from specshield.service.schemas.steps import StepRequest
from specshield.sim.service import follow_parent, own_server
from tests.serving import free_port

CASE, HEADING = "case1", 0.0
PING, PONG = 0x89, 0x8A  # frames that a server sends every 20 s, and wants back (RFC 6455, 5.5)
Ask = Callable[[dict[str, Any]], Awaitable[dict[str, Any]]]


class Connection:
    """One robot's connection, by HTTP/1.1 or a WebSocket, with as little as will do: the client shall not be
    the limit.
    """

    def __init__(self, port: int, packed: bool = False) -> None:
        self._port, self._packed = port, packed
        self.sent, self.got = 0, 0  # bytes

    async def open(self) -> None:
        self._reader, self._writer = await asyncio.open_connection("127.0.0.1", self._port)

    async def post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        content = msgpack.packb(body) if self._packed else json.dumps(body).encode()
        kind = "application/msgpack" if self._packed else "application/json"
        head = (
            f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1:{self._port}\r\nContent-Type: {kind}\r\n"
            f"Accept: {kind}\r\nContent-Length: {len(content)}\r\n\r\n"
        )
        self._writer.write(head.encode() + content)
        top = await self._reader.readuntil(b"\r\n\r\n")
        lines = top.lower().split(b"\r\n")
        length = next(int(line[15:]) for line in lines if line.startswith(b"content-length:"))
        answer = await self._reader.readexactly(length)
        self.sent, self.got = self.sent + len(head) + len(content), self.got + len(top) + length
        if lines[0].split()[1] not in (b"200", b"201"):
            raise RuntimeError(answer.decode())
        found: dict[str, Any] = msgpack.unpackb(answer) if self._packed else json.loads(answer)
        return found

    async def upgrade(self, path: str) -> None:
        key = "dGhlIHNhbXBsZSBub25jZQ=="  # any will do (RFC 6455, 1.2)
        head = (
            f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{self._port}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )
        self._writer.write(head.encode())
        top = await self._reader.readuntil(b"\r\n\r\n")
        if top.split()[1] != b"101":
            raise RuntimeError(top.decode())

    async def tell(self, body: dict[str, Any]) -> dict[str, Any]:
        """One message each way, in MessagePack; binary frames as RFC 6455, 5.2 has them, with a mask of 0."""
        content = msgpack.packb(body)
        size = (
            bytes([0xFE]) + len(content).to_bytes(2, "big")
            if len(content) > 125
            else bytes([0x80 + len(content)])
        )
        frame = b"\x82" + size + bytes(4) + content
        self._writer.write(frame)
        while (head := await self._reader.readexactly(2))[0] == PING:
            asked = await self._reader.readexactly(head[1])
            self._writer.write(bytes([PONG, 0x80 + head[1]]) + bytes(4) + asked)
        short = head[1] < 126
        length = head[1] if short else int.from_bytes(await self._reader.readexactly(2), "big")
        answer = await self._reader.readexactly(length)
        self.sent, self.got = self.sent + len(frame), self.got + (2 if short else 4) + length
        found: dict[str, Any] = msgpack.unpackb(answer)
        if head[0] != 0x82 or "status" in found:
            raise RuntimeError(found)
        return found


async def robot(
    ask: Ask, pose: list[float], steps: int, random: np.random.Generator, waits: list[float]
) -> None:
    for t in range(steps):
        body = {"t": t, "poses": [pose], "logits": random.normal(size=20).tolist()}
        began = time.perf_counter()
        answer = await ask(body)
        waits.append(time.perf_counter() - began)
        act = answer["action"] if answer["action"] != 4 else answer["completion_action"]
        pose = pose if act is None else answer["next_poses"][act]


async def drive(
    url: str,
    bare: int,
    way: str,
    robots: int,
    steps: int,
    seed: int,
    ready: Callable[[], None] = lambda: None,
) -> tuple[list[float], tuple[int, int]]:
    """Every robot's waits [s], and the bytes that all sent and got. way: `bare`, `json`, `msgpack`, `stream`
    or `session`. bare: that route's port. ready: called when all sessions have begun, before the first step.
    """
    port, waits = int(url.rpartition(":")[2]), list[float]()
    asks: list[Ask] = []
    connections: list[Connection] = []
    for i in range(robots):
        made = Connection(port)
        await made.open()
        if way == "session":
            connections.append(made)
            asks.append(lambda body, c=made, s=seed + i: _session(c, s))
            continue
        start = {"policy_id": CASE, "initial_pose": [4.5, 5.0, HEADING], "seed": seed + i}
        id = (await made.post("/v1/sessions", start))["id"]
        path = f"/v1/sessions/{id}/steps"
        connection = Connection(bare if way == "bare" else port, way == "msgpack")
        await connection.open()
        connections.append(connection)
        if way == "stream":
            await connection.upgrade(f"/v1/sessions/{id}/stream")
            asks.append(connection.tell)
        else:
            asks.append(lambda body, c=connection, p=path: c.post(p, body))
    ready()
    await asyncio.gather(
        *(
            robot(ask, [4.5, 5.0, HEADING], steps, np.random.default_rng([seed, i]), waits)
            for i, ask in enumerate(asks)
        )
    )
    return waits, (sum(each.sent for each in connections), sum(each.got for each in connections))


async def _session(connection: Connection, seed: int) -> dict[str, Any]:
    start = {"policy_id": CASE, "initial_pose": [4.5, 5.0, HEADING], "seed": seed}
    id = (await connection.post("/v1/sessions", start))["id"]
    await connection.post(f"/v1/sessions/{id}/close", {})
    return {"action": None}


def cpu(pids: list[int]) -> float:
    """Seconds of user and system time of these processes so far."""
    threads = [thread for pid in pids for thread in Path(f"/proc/{pid}/task").iterdir()]
    return sum(int((each / "schedstat").read_text().split()[0]) for each in threads) / 1e9


def family(pid: int) -> list[int]:
    """A process and all that came of it."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [pid, *(each for child in children for each in family(int(child)))]


def serve_bare(port: int) -> None:
    import uvicorn
    from fastapi import FastAPI

    app, answer = FastAPI(), example()

    @app.post("/v1/sessions/{session_id}/steps")
    async def step(session_id: str, body: StepRequest) -> Any:
        return answer

    uvicorn.run(app, host="127.0.0.1", port=port, log_level="warning", access_log=False)


def example() -> dict[str, Any]:
    """An answer as large as those of case 1 mostly are."""
    random = np.random.default_rng(0)
    return {
        "t": 40, "mode": "shaped", "distribution": random.dirichlet(np.ones(20)).tolist(),
        "j_values": np.ones(20).tolist(), "robustness": random.random(20).tolist(), "action": 0,
        "action_name": "m", "completion_action": 0, "spec_status": "pending", "feasible_mass": 0.83,
        "kl": 0.19, "reason": None, "finished": False, "next_poses": random.random((20, 3)).tolist(),
        "residual": {"translation": 1e-17, "rotation": 0.0}, "in_collision": False,
        "witness": random.integers(0, 20, 100).tolist(), "warnings": [],
    }  # fmt: skip


def _run(
    url: str, port: int, way: str, count: int, steps: int, seed: int, pids: list[int]
) -> dict[str, float]:
    """What a step costs these processes while `count` robots drive."""
    store = [pid for pid in pids if "valkey" in _command(pid).split(" ")[0]]
    before, taken = list[float](), count * steps

    def ready() -> None:
        before.extend((cpu(pids), cpu(store)))

    waits, (sent, got) = asyncio.run(drive(url, port, way, count, steps, seed, ready))
    row = {"us": 1e6 * (cpu(pids) - before[0]) / taken, "store": 1e6 * (cpu(store) - before[1]) / taken}
    row |= {"sent": sent / taken, "got": got / taken}
    return row | {f"p{q}": 1e3 * float(np.percentile(waits, q)) for q in (50, 99)}


def measure(robots: list[int], steps: int, rounds: int, seed: int, ways: list[str]) -> list[dict[str, Any]]:
    rows = []
    port = free_port()
    arguments = [sys.executable, "-m", "benchmarks.step_cost", "--serve-bare", str(port)]
    with own_server() as url, subprocess.Popen(arguments, preexec_fn=follow_parent) as bare:
        server = next(pid for pid in family(os.getpid()) if "specshield.cli" in _command(pid))
        try:
            _wait_for(port)
            asyncio.run(drive(url, port, "bare", 2, 20, seed))  # both warm
            asyncio.run(drive(url, port, "json", 2, 20, seed))
            while any("service.warmup" in _command(pid) for pid in family(server)):  # it still compiles
                time.sleep(0.2)
            for count in robots:
                runs: dict[str, list[dict[str, Any]]] = {way: [] for way in ways}
                for k in range(rounds):  # in turn, since the machine's pace changes
                    for way in ways:
                        pids = [bare.pid] if way == "bare" else family(server)
                        runs[way].append(_run(url, port, way, count, steps, seed + k, pids))
                for way, found in runs.items():
                    mean = {name: sum(run[name] for run in found) / rounds for name in found[0]}
                    rows.append({"robots": count, "way": way, **mean})
        finally:
            bare.terminate()
    return rows


def _wait_for(port: int) -> None:
    for _ in range(1200):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)
    raise RuntimeError("the bare route did not come up")


def _command(pid: int) -> str:
    with suppress(FileNotFoundError):
        return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
    return ""  # it has ended


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 16, 64])
    parser.add_argument("--steps", type=int, default=100, help="of each robot")
    parser.add_argument("--rounds", type=int, default=5, help="of all ways in turn; their mean is shown")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ways", nargs="+", default=["bare", "json", "msgpack", "stream"])
    parser.add_argument("--serve-bare", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve_bare:
        serve_bare(options.serve_bare)
        return
    print(
        f"{'robots':>6} {'way':>8} {'CPU us':>8} {'store':>6} {'x bare':>7} {'p50 ms':>8} {'x bare':>7}"
        f" {'p99 ms':>8} {'sent B':>7} {'got B':>7}"
    )
    bare: dict[str, Any] = {}
    for row in measure(options.robots, options.steps, options.rounds, options.seed, options.ways):
        bare = row if row["way"] == "bare" else bare
        ratio, wait = (row[name] / bare[name] if bare else float("nan") for name in ("us", "p50"))
        print(
            f"{row['robots']:6} {row['way']:>8} {row['us']:8.0f} {row['store']:6.0f} {ratio:7.2f}"
            f" {row['p50']:8.2f} {wait:7.2f} {row['p99']:8.2f} {row['sent']:7.0f} {row['got']:7.0f}"
        )


if __name__ == "__main__":
    main()
