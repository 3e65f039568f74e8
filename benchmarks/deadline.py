"""How much longer than its deadline a step of the SDK takes, against servers that do what none should.

    python -m benchmarks.deadline [--calls 20] [--deadline 0.2]

Both clients meet each server of benchmarks/hostile.py, one whose TLS handshake never ends, one whose name is
never looked up, and one that reads nothing of a body of some megabytes. A row says the longest and the median
call, and by how much the longest was over the deadline [ms]. The last row is how late `time.sleep` wakes on
the same machine at the same time. Exit status 1 if a call was more than 10 ms late.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import os
import socket
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

from benchmarks.hostile import hostile_servers
from specshield.client import AsyncSession, AsyncShieldClient, Session, SessionInfo, ShieldClient
from specshield.errors import SpecshieldError

SLACK = 0.010  # [s] that a call may last longer than its deadline
POSE = (1.0, 2.0, 0.5)
LOGITS = [0.0] * 20
INFO = SessionInfo(
    id="s",
    policy_ids=("p",),
    map_id="m",
    spec={},
    horizon=100,
    actions=tuple("abcdefghijklmnopqrst"),
    terminal_actions=(4,),
    next_t=0,
    feasible=True,
    spec_status="pending",
    main_task_done=False,
    finished=False,
    expires_at="",
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--calls", type=int, default=20, help="of each client to each server")
    parser.add_argument("--deadline", type=float, default=0.2, help="[s]")
    asked = parser.parse_args()
    unresolved = socket.getaddrinfo

    def resolver(host: Any, *args: Any, **options: Any) -> Any:
        if host == "never.test":
            time.sleep(10 * asked.deadline)
        return unresolved(host, *args, **options)

    socket.getaddrinfo = resolver  # type: ignore[assignment]
    print(f"{asked.calls} calls each, deadline {1e3 * asked.deadline:.0f} ms, load {os.getloadavg()[0]:.1f}")
    print(f"{'':28}{'longest':>10}{'median':>10}{'over':>8}  [ms]")
    worst = 0.0
    with hostile_servers() as ports:
        urls = {name: f"http://127.0.0.1:{port}" for name, port in ports.items()}
        urls["tls_never_ends"] = f"https://127.0.0.1:{ports['silent']}"
        urls["name_not_looked_up"] = "http://never.test:9"
        urls["reads_nothing"] = urls["silent"]
        for name, url in urls.items():
            for way in (blocking, awaiting):
                times = way(url, asked.calls, asked.deadline, 40_000 if name == "reads_nothing" else 0)
                worst = max(worst, row(f"{name}, {way.__name__}", times, asked.deadline))
    row("time.sleep", [timed(lambda: time.sleep(asked.deadline)) for _ in range(asked.calls)], asked.deadline)
    print(f"worst overrun {1e3 * worst:.1f} ms")
    return 0 if worst <= SLACK else 1


def row(name: str, times: list[float], deadline: float) -> float:
    over = max(0.0, max(times) - deadline)
    print(
        f"{name:28}{1e3 * max(times):10.1f}{1e3 * statistics.median(times):10.1f}{1e3 * over:8.1f}",
        flush=True,
    )
    return over


def timed(call: Callable[[], object]) -> float:
    gc.collect()
    began = time.perf_counter()
    try:
        call()
    except SpecshieldError:
        return time.perf_counter() - began
    return time.perf_counter() - began


def blocking(url: str, calls: int, deadline: float, recorded: int) -> list[float]:
    with ShieldClient(url, timeout=0.5) as client:
        session = Session(client._run, INFO, POSE)
        for _ in range(recorded):
            session.record(POSE)
        return [timed(lambda: session.step(POSE, LOGITS, deadline=deadline)) for _ in range(calls)]


def awaiting(url: str, calls: int, deadline: float, recorded: int) -> list[float]:
    async def run() -> list[float]:
        async with AsyncShieldClient(url, timeout=0.5) as client:
            session = AsyncSession(client._run, INFO, POSE)
            for _ in range(recorded):
                session.record(POSE)
            times = []
            for _ in range(calls):
                gc.collect()
                began = time.perf_counter()
                try:
                    await session.step(POSE, LOGITS, deadline=deadline)
                except SpecshieldError:
                    times.append(time.perf_counter() - began)
            return times

    return asyncio.run(run())


if __name__ == "__main__":
    sys.exit(main())
