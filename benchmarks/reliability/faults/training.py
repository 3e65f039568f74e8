"""Rows in which a training run is killed, or its worker."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import httpx

from benchmarks.reliability import plant
from benchmarks.reliability.faults.kills import Scene
from benchmarks.reliability.figures import spread
from benchmarks.reliability.plant import Service, wait_for
from benchmarks.reliability.robots import POLICY

LONG = {"updates": 1_000_000, "evaluate_every": 1_000_000, "robots": 16, "batch": 32, "units": 8}
LONG |= {"evaluation_starts": 20, "replay": 1000}


def run_killed(scene: Scene) -> dict[str, Any]:
    """SIGKILL of the process that trains: the policy is `failed`, says why, and trains again."""
    return _killed(scene, _run)


def worker_killed(scene: Scene) -> dict[str, Any]:
    """SIGKILL of the worker that trains: the policy is `failed`, says why, and trains again at another."""
    return _killed(scene, _worker)


def _killed(scene: Scene, whom: Callable[[Service], int]) -> dict[str, Any]:
    said, again = list[float](), list[float]()
    silent = 0
    with (
        Service(scene.folder / "data", SPECSHIELD_WORKER="true") as service,
        httpx.Client(base_url=service.url, timeout=60.0, trust_env=False) as http,
    ):
        known = http.get(f"/v1/policies/{POLICY}").json()
        asked = {
            "map_id": known["map_id"],
            "robot": "stretch",
            "spec": known["spec"],
            "method": "dqn",
            "options": LONG,
        }
        id = _ask(http, asked)
        for _ in range(scene.n):
            _until(http, id, "training")
            time.sleep(0.3)
            moment = time.monotonic()
            os.kill(whom(service), signal.SIGKILL)
            silent += not _until(http, id, "failed")["error"]
            said.append(time.monotonic() - moment)
            moment = time.monotonic()
            _ask(http, asked)
            _until(http, id, "training")
            again.append(time.monotonic() - moment)
        http.delete(f"/v1/policies/{id}")
    return {
        "kills": scene.n,
        "failed_without_reason": silent,
        "failed_after_s": spread(said),
        "trains_again_after_s": spread(again),
    }


def _ask(http: httpx.Client, body: dict[str, Any]) -> str:
    ends = time.monotonic() + 60.0
    while True:
        answer = http.post("/v1/policies", json=body)
        if answer.status_code == 202:
            return str(answer.json()["id"])
        if answer.status_code != 503 or time.monotonic() > ends:
            raise RuntimeError(f"{answer.status_code} {answer.text[:500]}")
        time.sleep(0.1)


def _until(http: httpx.Client, id: str, status: str) -> dict[str, Any]:
    found: dict[str, Any] = {}

    def reached() -> bool:
        found.update(http.get(f"/v1/policies/{id}").json())
        return found["status"] == status

    wait_for(reached, 120.0, f"a policy that is {status}")
    return found


def _run(service: Service) -> int:
    """The process that trains: a fork of the learner."""
    found = list[int]()

    def look() -> bool:
        with suppress(OSError):
            found[:] = [
                pid for pid in _learners(service) if "--learner" in plant.command_of(plant.parent(pid))
            ]
        return bool(found)

    wait_for(look, 60.0, "a process that trains")
    return found[0]


def _worker(service: Service) -> int:
    """The worker that has the run: the one that the server's own worker began for what takes long."""
    return plant.parent(_run(service))


def _learners(service: Service) -> list[int]:
    return [pid for pid in plant.children(service.pid) if "--learner" in plant.command_of(pid)]
