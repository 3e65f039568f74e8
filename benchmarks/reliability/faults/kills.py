"""Rows in which a process is killed, stopped or told to end while robots drive."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import redis

from benchmarks.reliability import plant
from benchmarks.reliability.faults.crowd import Crowd
from benchmarks.reliability.figures import spread
from benchmarks.reliability.plant import RedisServer, Service, wait_for

HELD = 2.5  # [s] that a stopped store is held: longer than the 2 s that a server waits for an answer of it


@dataclass(frozen=True)
class Scene:
    """What every row gets. n: faults. folder: its own, empty. reference: a server that nothing happens to.
    starts: poses to begin at.
    """

    n: int
    folder: Path
    reference: str
    starts: list[list[float]]


def server_embedded(scene: Scene) -> dict[str, Any]:
    """SIGKILL of the server, embedded store; started again at once."""
    with Service(scene.folder / "data") as service:
        return _server(scene, service)


def server_redis(scene: Scene) -> dict[str, Any]:
    """SIGKILL of the server, Debian's redis-server as store."""
    with (
        RedisServer(scene.folder / "redis") as store,
        Service(scene.folder / "data", REDIS_URL=store.url) as service,
    ):
        return _server(scene, service)


def _server(scene: Scene, service: Service) -> dict[str, Any]:
    with Crowd([service.url], scene.starts, 4) as crowd:
        for _ in range(scene.n):
            crowd.fault(service.kill, service.start)
    return {"kills": scene.n, **crowd.result(service.url, scene.reference)}


def store_embedded(scene: Scene) -> dict[str, Any]:
    """SIGKILL of the embedded store; the server starts it again."""

    def kill() -> None:
        os.kill(service.store_pid(), signal.SIGKILL)

    with Service(scene.folder / "data") as service:
        return _store(scene, service, kill)


def keeper(scene: Scene) -> dict[str, Any]:
    """SIGKILL of the keeper of the embedded store, with which the store ends. The server starts both."""

    def kill() -> None:
        os.kill(plant.parent(service.store_pid()), signal.SIGKILL)

    with Service(scene.folder / "data") as service:
        return _store(scene, service, kill)


def _store(scene: Scene, service: Service, kill: Any) -> dict[str, Any]:
    def patiently() -> None:
        wait_for(lambda: _done(kill), 30.0, "a store to kill")

    with Crowd([service.url], scene.starts, 4) as crowd:
        for _ in range(scene.n):
            crowd.fault(patiently)
    return {"kills": scene.n, **crowd.result(service.url, scene.reference)}


def _done(kill: Any) -> bool:
    with suppress(redis.RedisError, OSError):
        kill()
        return True
    return False


def redis_restarted(scene: Scene) -> dict[str, Any]:
    """SIGKILL of redis-server, which is started again after half a second."""
    refused, unready = list[float](), 0

    def mend() -> None:
        nonlocal unready
        began = time.monotonic()
        answer = httpx.get(f"{service.url}/readyz", timeout=10.0, trust_env=False)
        refused.append(time.monotonic() - began)
        unready += answer.status_code == 503
        time.sleep(max(0.0, 0.5 - (time.monotonic() - began)))
        store.start()
        wait_for(store.answers, 30.0, "a store that answers")

    with (
        RedisServer(scene.folder / "redis") as store,
        Service(scene.folder / "data", REDIS_URL=store.url) as service,
    ):
        with Crowd([service.url], scene.starts, 4) as crowd:
            for _ in range(scene.n):
                crowd.fault(store.kill, mend)
        found = crowd.result(service.url, scene.reference)
    return {"kills": scene.n, **found, "readyz_503": unready, "readyz_s": spread(refused)}


def store_stopped(scene: Scene) -> dict[str, Any]:
    """SIGSTOP of redis-server for 2.5 s, then SIGCONT. away: from SIGCONT on."""
    with (
        RedisServer(scene.folder / "redis") as store,
        Service(scene.folder / "data", REDIS_URL=store.url) as service,
        Crowd([service.url], scene.starts, 4) as crowd,
    ):
        for _ in range(scene.n):
            store.signal(signal.SIGSTOP)
            time.sleep(HELD)
            crowd.fault(lambda: store.signal(signal.SIGCONT))
        crowd.over.set()
        for robot in crowd.robots:
            robot.join(180.0)
        slow = [t.ended - t.began for r in crowd.robots for t in r.tries if t.status in (0, 503)]
        found = crowd.result(service.url, scene.reference)
    return {"stops": scene.n, **found, "refusal_s": spread(slow)}


def sigterm(scene: Scene) -> dict[str, Any]:
    """SIGTERM of the server with 8 robots; started again when it has ended.

    not_retriable: answers by which a robot could not tell that asking again helps.
    """
    codes, seconds = list[int](), list[float]()

    def stop() -> None:
        code, took = service.stop()
        codes.append(code)
        seconds.append(took)

    with Service(scene.folder / "data") as service:
        with Crowd([service.url], scene.starts, 8) as crowd:
            for _ in range(scene.n):
                crowd.fault(stop, service.start, gradual=True)
        found = crowd.result(service.url, scene.reference)
    good = (0, 200, 201, 409, 502, 503, 504)
    bad = sum(count for status, count in crowd.statuses().items() if status not in good)
    ends = {"exit_not_0": sum(code != 0 for code in codes), "exit_s": spread(seconds)}
    return {"stops": scene.n, **found, **ends, "not_retriable": bad}


def workers(scene: Scene) -> dict[str, Any]:
    """`--workers 2`, one of them killed; the supervisor replaces it. away: until every robot was answered,
    which the other worker may do. replaced_s: until two workers are ready again.
    """
    replaced = list[float]()

    def serving() -> list[int]:
        return [pid for pid in plant.children(service.pid) if "spawn_main" in plant.command_of(pid)]

    with Service(scene.folder / "data", "--workers", "2") as service:
        wait_for(lambda: service.log.read_text().count(" ready\n") >= 2, plant.START, "two workers")
        with Crowd([service.url], scene.starts, 4) as crowd:
            for i in range(scene.n):
                pids, said = serving(), service.log.read_text().count(" ready\n")
                moment = crowd.fault(lambda pids=pids, i=i: os.kill(pids[i % len(pids)], signal.SIGKILL))
                wait_for(
                    lambda said=said: service.log.read_text().count(" ready\n") > said,
                    plant.START,
                    "a new worker",
                )
                replaced.append(time.monotonic() - moment)
        found = crowd.result(service.url, scene.reference)
    return {"kills": scene.n, **found, "replaced_s": spread(replaced)}
