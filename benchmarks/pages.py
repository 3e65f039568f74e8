"""What open pages cost a robot: a decision's p99 with ten pages on 32 robots, and with none.

    python -m benchmarks.pages [--robots 32] [--pages 10] [--rate 2] [--rounds 8] [--seconds 10] [--seed 0]

Rounds with pages and rounds without take turns, so that whatever else the machine does meets both alike.
Each round has sessions of its own. A page is what the browser keeps open: one stream of `/v1/events` with all
of the robots, read to the end as it comes, in a process of its own; what a browser draws is not in it. A
decision is timed by the robot that waits for it [ms], and by the server (`Server-Timing: total`). The CPU
that the server takes, for each step [ms], is what pages cost it where other work blurs the clock.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import httpx
import numpy as np

from benchmarks.timing import machine
from specshield.sim.service import own_server

START = [5.0, 5.0, 0.0]
Times = list[tuple[float, float]]  # [ms] of each step: waited, and in the server


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    for name, default in (("robots", 32), ("pages", 10), ("rounds", 8), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--rate", type=float, default=2.0, help="steps a second of each robot")
    parser.add_argument("--seconds", type=float, default=10.0, help="of a round")
    asked = parser.parse_args()
    times: dict[int, Times] = {0: [], asked.pages: []}
    cpu = {0: 0.0, asked.pages: 0.0}  # [s] of the server
    with own_server() as url:
        server = int(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()[0])
        for number in range(-1, 2 * asked.rounds):
            pages = asked.pages if number % 2 else 0
            found, took = measured(url, server, asked, pages, max(number, 0) // 2)
            if number >= 0:  # the one before loads what is loaded once
                times[pages] += found
                cpu[pages] += took
    print(machine())
    print(f"{asked.robots} robots, {asked.rate:g} steps/s each; {asked.rounds} rounds of {asked.seconds:g} s")
    print(
        "| pages open | steps | waited p50 | p99 | in the server p50 | p99 | CPU a step |\n"
        + "|--:" * 7
        + "|"
    )
    for pages, taken in times.items():
        cells = " | ".join(f"{value:.2f}" for value in np.percentile(taken, (50, 99), axis=0).T.ravel())
        print(f"| {pages} | {len(taken)} | {cells} | {1e3 * cpu[pages] / len(taken):.2f} |")
    none, some = (np.percentile(taken, 99, axis=0) for taken in times.values())
    print(f"p99 with pages to that without: waited {some[0] / none[0]:.3f}, server {some[1] / none[1]:.3f}")


def measured(
    url: str, server: int, asked: argparse.Namespace, pages: int, number: int
) -> tuple[Times, float]:
    """The steps of one round, and the server's CPU in it [s]."""
    with httpx.Client(base_url=url, timeout=60.0) as client:
        ids = [begun(client, 1000 * asked.seed + 100 * number + i) for i in range(asked.robots)]
        readers = None
        if pages:
            command = [sys.executable, "-m", "benchmarks.pages", "read", url, str(pages), *ids]
            readers = subprocess.Popen(command, preexec_fn=lambda: os.nice(5))
            while f"specshield_watchers {pages}.0" not in client.get("/metrics").text:
                time.sleep(0.05)
        # Each robot has its connection before the clock runs: making 32 of them takes a processor.
        with ExitStack() as stack, ThreadPoolExecutor(asked.robots) as robots:
            own = [stack.enter_context(httpx.Client(base_url=url, timeout=60.0)) for _ in ids]
            for robot in own:
                robot.get("/readyz").raise_for_status()
            began, until = cpu_of(server), time.monotonic() + asked.seconds
            given = [
                (robot, id, asked.rate, until, i) for i, (robot, id) in enumerate(zip(own, ids, strict=True))
            ]
            found = list(robots.map(lambda robot: driven(*robot), given))
            took = cpu_of(server) - began
        if readers is not None:
            readers.terminate()
            readers.wait()
        for id in ids:
            client.delete(f"/v1/sessions/{id}")
    return [step for steps in found for step in steps], took


def cpu_of(process: int) -> float:
    """The CPU that a process has taken [s], by Linux's account of it."""
    user, system = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def begun(client: httpx.Client, seed: int) -> str:
    body = {"policy_id": "case1", "initial_pose": START, "seed": seed, "uncertainty": "none"}
    answer = client.post("/v1/sessions", json=body)
    answer.raise_for_status()
    return str(answer.json()["id"])


def driven(client: httpx.Client, id: str, rate: float, until: float, number: int) -> Times:
    """A robot that steps at its rate, and goes where it is told."""
    random, pose, times, t = np.random.default_rng(number), START, Times(), 0
    due = time.monotonic() + random.random() / rate
    while due < until:
        time.sleep(max(0.0, due - time.monotonic()))
        body = {"t": t, "poses": [pose], "logits": random.normal(0.0, 2.0, 20).tolist()}
        began = time.perf_counter()
        answer = client.post(f"/v1/sessions/{id}/steps", json=body)
        waited = 1e3 * (time.perf_counter() - began)
        answer.raise_for_status()
        told = dict(part.split(";dur=") for part in answer.headers["server-timing"].split(", "))
        times.append((waited, float(told["total"])))
        decision = answer.json()
        action = decision["completion_action"] if decision["action_name"] == "end" else decision["action"]
        pose, t, due = decision["next_poses"][action or 0], t + 1, due + 1.0 / rate
    return times


async def read(url: str, pages: int, ids: list[str]) -> None:
    """The streams of so many pages, to their end."""

    async def page() -> None:
        async with (
            httpx.AsyncClient(base_url=url, timeout=None) as client,
            client.stream("GET", "/v1/events", params={"session": ids}) as response,
        ):
            async for _ in response.aiter_raw():
                pass

    await asyncio.gather(*(page() for _ in range(pages)))


if __name__ == "__main__":
    if sys.argv[1:2] == ["read"]:
        asyncio.run(read(sys.argv[2], int(sys.argv[3]), sys.argv[4:]))
    else:
        main()
