"""What one caller can do to the others: a robot steps while somebody attacks its server.

    python -m benchmarks.attacks                    # every attack, on a server of its own
    python -m benchmarks.attacks --only headers     # one of them
    python -m benchmarks.attacks --only changing_maps   # no attack: robots whose maps change all the time

For each attack: the robot's 99th percentile before it and during it [ms], and the memory of the server and
its child processes before it, at its most and 75 s after it [MB]. An attack is bounded in count and in time,
is only ever sent to a loopback address, and runs in a process of its own.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np

LASTS = 20.0  # [s] at most, of one attack
QUIET = 10.0  # [s] of the robot alone
BACK = 1.10  # of the memory before an attack: it counts as back
SETTLES = (
    660.0  # [s] that this may take: a process ends after 60 without work, one of slow decisions after 600
)
RATE = 20.0  # steps a second that the robot asks for
START = [5.0, 5.0, 0.0]
ORIGIN = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
JSON = {"Content-Type": "application/json"}


# --- the attacks: each takes the server's URL and returns when it is over


def big_map(url: str) -> None:
    """F1: valid maps of 4,000 x 4,000 cells, 32 MB of JSON each."""
    content = _grid(16_000_000)
    _repeat(url, 4, lambda client: client.post("/v1/maps", content=content, headers=JSON))


def wrong_map(url: str) -> None:
    """F1: 60 MB of JSON that is no map."""
    content = b'{"format":"occupancy_grid","info":{},"data":[' + b"1.5," * 15_000_000 + b"0]}"
    _repeat(url, 4, lambda client: client.post("/v1/maps", content=content, headers=JSON))


def listing(url: str) -> None:
    """F2: a policy with 200 regions that its formula does not name, 50 sessions of it, all of them listed."""
    with _client(url) as client:
        corners = [[3.0 * np.cos(a), 3.0 * np.sin(a)] for a in np.linspace(0.0, 6.28, 100, endpoint=False)]
        regions = {f"R{i}": {"type": "polygon", "vertices": corners} for i in range(200)}
        spec = {"formula": "F[0,60] x > 0", "regions": regions}
        made = _policy(client, {"map_id": "case1", "spec": spec, "method": "reachability"})
        for _ in range(50 if made else 0):
            client.post("/v1/sessions", json={"policy_id": made, "initial_pose": START})
    _repeat(url, 100, lambda client: client.get("/v1/sessions?limit=1000"))
    _repeat(url, 100, lambda client: client.get("/v1/policies?limit=1000"))


def expensive_house(url: str) -> None:
    """F7: a house of three rooms with 1,000 vertices each, on 4,000 x 4,000 cells: 177 kB."""
    angles = np.linspace(0.0, 2 * np.pi, 1000, endpoint=False)
    outline = [{"x": 99 + 99 * np.cos(a), "y": 0.0, "z": 99 + 99 * np.sin(a)} for a in angles]
    rooms = [{"roomType": "Kitchen", "floorPolygon": outline} for _ in range(3)]
    house = {"rooms": rooms, "walls": [], "doors": [], "objects": []}
    body = {"format": "procthor", "house": house, "asset_sizes": {}, "resolution": 0.05}
    _repeat(url, 4, lambda client: client.post("/v1/maps", json=body))


def planners(url: str) -> None:
    """F7: twelve robots with a planner, horizon 900, as fast as they get answers."""
    areas = {f"P{i}": {"type": "circle", "center": [4.0 + i, 5.0], "radius": 0.7} for i in range(3)}
    patrol = " and ".join(f"G[0,800] F[0,100] {name}" for name in areas)
    with _client(url) as client:
        spec = {"formula": patrol, "regions": areas}
        made = _policy(client, {"map_id": "case1", "spec": spec, "method": "planner"})
    if made is None:
        raise SystemExit("the planner's policy was not ready in time")

    def drive(client: httpx.Client) -> None:
        body = {"policy_id": made, "initial_pose": START, "allow_infeasible": True}
        _step_until(client, body, time.monotonic() + LASTS / 2)

    _at_once(12, lambda: _with_client(url, drive))


def endless_lookahead(url: str) -> None:
    """F7: sessions of 1e30 steps with look-ahead, which have to be refused before anything is prepared."""
    body = {"policy_id": "case1", "initial_pose": START, "max_steps": 10**30, "shaping": "lookahead"}
    _repeat(url, 50, lambda client: client.post("/v1/sessions", json=body))


def unknown_fields(url: str) -> None:
    """F7: steps and formulas with 60,000 fields that nobody knows."""
    content = json.dumps({f"field{i}": 0 for i in range(60_000)}).encode()[: 1 << 20]
    for path in ("/v1/specs/validate", "/v1/sessions/none/steps", "/v1/sessions"):
        _repeat(url, 20, lambda client, path=path: client.post(path, content=content, headers=JSON))


def connections(url: str) -> None:
    """F11: 1,100 connections that say nothing, and 400 that send a byte of a header now and then."""
    with contextlib.ExitStack() as held:
        for _ in range(1100):
            with contextlib.suppress(OSError):
                held.enter_context(_connect(url))
        slow = [held.enter_context(_connect(url)) for _ in range(400)]
        for connection in slow:
            with contextlib.suppress(OSError):
                connection.sendall(b"GET /livez HTTP/1.1\r\nX-Slow: ")
        end = time.monotonic() + LASTS
        while time.monotonic() < end:
            for connection in slow:
                with contextlib.suppress(OSError):
                    connection.sendall(b"a")
            time.sleep(0.5)


def headers(url: str) -> None:
    """F11: heads of 100 MB."""
    for _ in range(4):
        with _connect(url) as connection, contextlib.suppress(OSError):
            connection.sendall(b"GET /livez HTTP/1.1\r\nX-Large: ")
            for _ in range(100):
                connection.sendall(b"a" * (1 << 20))


def half_bodies(url: str) -> None:
    """F11: 16 uploads of 59 MB, each left when half of it is sent."""
    size = 59 << 20
    head = f"POST /v1/maps HTTP/1.1\r\nHost: {urlsplit(url).netloc}\r\nContent-Type: application/json\r\n"

    def send() -> None:
        with _connect(url) as connection, contextlib.suppress(OSError):
            connection.sendall(f"{head}Content-Length: {size}\r\n\r\n".encode())
            for _ in range(size // 2 >> 20):
                connection.sendall(b" " * (1 << 20))
            time.sleep(LASTS / 2)

    _at_once(16, send)


def long_histories(url: str) -> None:
    """Steps that carry 10,000 poses: the first of a session, and some that send all of them again."""
    body = {"policy_id": "case1", "initial_pose": START, "max_steps": 10_000, "allow_infeasible": True}
    told, end = json.dumps([START] * 9_991)[1:-1], time.monotonic() + LASTS

    def send(client: httpx.Client) -> None:
        while time.monotonic() < end:
            session = client.post("/v1/sessions", json=body).raise_for_status().json()
            path, logits = f"/v1/sessions/{session['id']}/steps", json.dumps([0.0] * 20)
            for t in range(9_990, 10_000):
                poses = told + f",{json.dumps(START)}" * (t - 9_990)
                step = f'{{"t":{t},"poses":[{poses}],"logits":{logits}}}'
                client.post(path, content=step, headers=JSON)
            client.delete(f"/v1/sessions/{session['id']}")

    _at_once(8, lambda: _with_client(url, send))


def changing_maps(url: str) -> None:
    """Four robots that see a new obstacle at every step, ten steps a second, so that each decides
    on a map of its own and tables are made anew all the time.
    """
    random = np.random.default_rng(0)

    def see(pose: list[float]) -> dict[str, Any]:
        angle, far = random.uniform(-np.pi, np.pi), random.uniform(1.0, 2.0)
        thing = [pose[0] + far * np.cos(angle), pose[1] + far * np.sin(angle)]
        return {"occupied": [[thing[0] + dx, thing[1] + dy] for dx in (0.0, 0.05) for dy in (0.0, 0.05)]}

    def drive(client: httpx.Client) -> None:
        body = {"policy_id": "case1", "initial_pose": START, "allow_infeasible": True, "map_memory": 10}
        _step_until(client, body, time.monotonic() + LASTS, 0.1, see)

    _at_once(4, lambda: _with_client(url, drive))


ATTACKS: dict[str, Callable[[str], None]] = {
    made.__name__: made
    for made in (
        big_map, wrong_map, listing, expensive_house, planners, endless_lookahead, unknown_fields,
        connections, headers, half_bodies, long_histories,
    )
}  # fmt: skip
# Robots, not attacks. What they take of the memory is kept: 256 MiB of tables (service/heavy/tables.py).
ROBOTS: dict[str, Callable[[str], None]] = {changing_maps.__name__: changing_maps}
ALL = {**ATTACKS, **ROBOTS}


def _client(url: str) -> httpx.Client:
    return httpx.Client(base_url=url, timeout=60.0)


def _with_client(url: str, action: Callable[[httpx.Client], None]) -> None:
    with _client(url) as client:
        action(client)


def _repeat(url: str, times: int, ask: Callable[[httpx.Client], Any]) -> None:
    """`times` requests in all by four callers, none begun after the attack's time is over."""
    end = time.monotonic() + LASTS

    def some() -> None:
        with _client(url) as client:
            for _ in range(-(-times // 4)):
                if time.monotonic() < end:
                    with contextlib.suppress(httpx.TransportError):
                        ask(client)

    _at_once(4, some)


def _at_once(callers: int, action: Callable[[], None]) -> None:
    threads = [threading.Thread(target=action) for _ in range(callers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _connect(url: str) -> socket.socket:
    parts = urlsplit(url)
    return socket.create_connection((parts.hostname or "", parts.port or 80), timeout=5.0)


def _grid(cells: int) -> bytes:
    side = int(cells**0.5)
    info = {"resolution": 0.05, "width": side, "height": side, "origin": ORIGIN}
    head = json.dumps({"format": "occupancy_grid", "info": info})[:-1].encode()
    return head + b',"data":[' + b"0," * (side * side - 1) + b"0]}"


def _policy(client: httpx.Client, body: dict[str, Any]) -> str | None:
    """The id of a policy once it is ready; None where it is refused or takes more than three minutes."""
    answer = client.post("/v1/policies", json=body)
    end = time.monotonic() + 180.0
    while answer.status_code in (200, 202) and time.monotonic() < end:
        if answer.json()["status"] == "ready":
            return str(answer.json()["id"])
        time.sleep(0.2)
        answer = client.get(f"/v1/policies/{answer.json()['id']}")
    return None


def _step_until(
    client: httpx.Client,
    body: dict[str, Any],
    end: float,
    pause: float = 0.0,
    see: Callable[[list[float]], dict[str, Any]] = lambda pose: {},
) -> list[float]:
    """Steps through sessions until `end`, every action as it is drawn; the milliseconds of each answer.

    see: what a step says beside pose and logits.
    """
    took = list[float]()
    session: dict[str, Any] | None = None
    while time.monotonic() < end:
        if session is None:
            session = client.post("/v1/sessions", json=body).raise_for_status().json()
            pose, t, logits = body["initial_pose"], 0, [0.0] * len(session["actions"])
        began = time.perf_counter()
        step = {"t": t, "poses": [pose], "logits": logits, **see(pose)}
        answer = client.post(f"/v1/sessions/{session['id']}/steps", json=step)
        took.append(1000 * (time.perf_counter() - began))
        if answer.status_code != 200 or answer.json()["finished"] or t > 100:
            session = None
            continue
        pose, t = answer.json()["next_poses"][answer.json()["action"]], t + 1
        time.sleep(max(pause - took[-1] / 1000, 0.0))
    return took


# --- what they do to a robot


def measure(url: str, pid: int, names: list[str]) -> Iterator[dict[str, Any]]:
    """pid: of the server's process, whose descendants count as well, but for the store."""
    robot = {"policy_id": "case1", "initial_pose": START, "allow_infeasible": True}
    with _client(url) as client:
        _step_until(client, robot, time.monotonic() + 3.0, 1 / RATE)
        for name in names:
            quiet = _step_until(client, robot, time.monotonic() + QUIET, 1 / RATE)
            before, most = _memory(pid), 0.0
            attacker = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.attacks", "--attack", name, "--url", url]
            )
            under = list[float]()
            end = time.monotonic() + 300.0
            while attacker.poll() is None and time.monotonic() < end:
                under += _step_until(client, robot, time.monotonic() + 0.5, 1 / RATE)
                most = max(most, _memory(pid))
            attacker.kill()
            attacker.wait()
            after, seconds = _settled(pid, before)
            yield {
                "attack": name,
                "steps": len(under),
                "p99_quiet_ms": round(float(np.percentile(quiet, 99)), 1),
                "p99_attack_ms": round(float(np.percentile(under, 99)), 1),
                "worst_ms": round(max(under), 1),
                "memory_before_mb": before,
                "memory_most_mb": most,
                "memory_after_mb": after,
                "memory_after_s": seconds,
            }


def _settled(pid: int, before: float) -> tuple[float, float]:
    """The memory when it is back [MB] and how long that took [s]; as it is after `SETTLES` if it is not."""
    begun = time.monotonic()
    while (memory := _memory(pid)) > BACK * before and time.monotonic() < begun + SETTLES:
        time.sleep(1.0)
    return memory, round(time.monotonic() - begun, 0)


def _memory(pid: int) -> float:
    """Megabytes that a process and its descendants hold, shared pages counted once (PSS)."""
    total, pending = 0, [pid]
    while pending:
        found = Path(f"/proc/{pending.pop()}")
        with contextlib.suppress(OSError):
            lines = (found / "smaps_rollup").read_text().splitlines()
            total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
            pending += map(int, (found / "task" / found.name / "children").read_text().split())
    return round(total / 1024, 1)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--only", action="append", choices=sorted(ALL))
    options.add_argument("--attack", choices=sorted(ALL), help=argparse.SUPPRESS)
    options.add_argument("--url", help="a server that runs already, on a loopback address")
    options.add_argument("--pid", type=int, help="of that server's process")
    chosen = options.parse_args()
    if chosen.url and urlsplit(chosen.url).hostname not in ("127.0.0.1", "::1", "localhost"):
        sys.exit("attacks are for a server on this machine")
    if chosen.attack:
        ALL[chosen.attack](chosen.url)
        return
    names = chosen.only or list(ATTACKS)
    if chosen.url:
        for row in measure(chosen.url, chosen.pid, names):
            print(json.dumps(row), flush=True)
        return
    from specshield.sim.service import own_server

    with own_server(worker=True) as url:
        for row in measure(url, _server(), names):
            print(json.dumps(row), flush=True)


def _server() -> int:
    """The server's process: this one's only child."""
    return int(Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()[0])


if __name__ == "__main__":
    main()
