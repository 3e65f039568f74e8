"""Many robots for a long time: does memory stay, does the service stay as quick, what does a step cost?

Robots by plain httpx with a connection kept open, from processes of their own, each as fast as it is answered
(or at a rate). One row every INTERVAL seconds.
"""

from __future__ import annotations

import json
import multiprocessing
import random
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.reliability import plant
from benchmarks.reliability.figures import about, write
from benchmarks.reliability.plant import Service, wait_for
from benchmarks.reliability.robots import POLICY, find_starts, logits_of
from benchmarks.timing import summary

INTERVAL = 10.0  # [s] between two looks at memory and CPU
CLIENTS = 2  # processes that the robots are in
EDGE = 60.0  # [s] at the beginning and at the end whose p99 are compared
WARM = 20.0  # [s] that are not counted: connections open, caches fill


def run(out: Path, robots: int, seconds: float, rate: float, options: Sequence[str], command: str) -> int:
    """1 if an answer was not 200 (201 for a session), or one of the bounds of issue 12 was not kept."""
    scratch = Path(tempfile.mkdtemp(prefix="rel-"))
    settings = dict(option.split("=", 1) for option in options)
    try:
        with Service(scratch / "data", **settings) as service:
            starts = find_starts(service.url, 12)
            figures = _measure(service, starts, robots, seconds, rate)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    figures |= {"robots": robots, "seconds": seconds, "rate": rate, "settings": settings, **about(command)}
    write(out, "load", figures)
    print(json.dumps({k: v for k, v in figures.items() if k != "rows"}, indent=1))
    return 0 if figures["not_200"] == 0 and figures["p99_last_to_first"] <= 1.5 else 1


def _measure(
    service: Service, starts: Sequence[Sequence[float]], robots: int, seconds: float, rate: float
) -> dict[str, Any]:
    context = multiprocessing.get_context("spawn")
    told = context.Queue()
    begins = context.Value("d", 0.0)
    shares = [list(range(i, robots, CLIENTS)) for i in range(CLIENTS)]
    clients = [
        context.Process(
            target=_client, args=(told, begins, service.url, share, starts, seconds + WARM, rate), daemon=True
        )
        for share in shares
    ]
    for client in clients:
        client.start()
    for _ in clients:
        told.get(timeout=120.0)  # it is there
    began = begins.value = time.monotonic() + 0.5
    rows = list[dict[str, float]]()
    while time.monotonic() < began + WARM + seconds:
        time.sleep(max(0.0, began + WARM + INTERVAL * len(rows) - time.monotonic()))
        rows.append(_look(service, clients) | {"at_s": round(time.monotonic() - began, 1)})
    rows.append(_look(service, clients) | {"at_s": round(time.monotonic() - began, 1)})
    results = [told.get(timeout=120.0) for _ in clients]
    took = np.concatenate([np.array(result["took"]).reshape(-1, 2) for result in results])
    took = took[took[:, 0] >= WARM]  # when it was asked [s], how long it took [s]
    statuses: Counter[str] = sum((Counter(result["statuses"]) for result in results), Counter())
    edge = min(EDGE, seconds / 3)
    first = took[took[:, 0] < WARM + edge, 1]
    last = took[took[:, 0] >= WARM + seconds - edge, 1]
    counted = int(np.count_nonzero(took[:, 0] < rows[-1]["at_s"]))
    cpu = {name: rows[-1][name] - rows[0][name] for name in ("server_cpu_s", "store_cpu_s")}
    good = statuses["200"] + statuses["201"]
    p99 = {
        name: round(1e3 * float(np.percentile(part, 99)), 3)
        for name, part in (("first", first), ("last", last))
    }
    return {
        "steps": len(took),
        "steps_a_second": round(len(took) / seconds, 1),
        "answers": dict(statuses),
        "not_200": sum(statuses.values()) - good,
        "took_ms": summary(took[:, 1].tolist()),
        "edge_s": edge,
        "p99_first_ms": p99["first"],
        "p99_last_ms": p99["last"],
        "p99_last_to_first": round(p99["last"] / p99["first"], 3),
        "cpu_ms_a_step": {name: round(1e3 * value / counted, 4) for name, value in cpu.items()},
        **{f"{name}_mb": _trend(rows, name) for name in ("server", "store")},
        "rows": rows,
    }


def _look(service: Service, clients: Sequence[Any]) -> dict[str, float]:
    """Memory [bytes] and CPU [s] of the server with all below it but the store, and of the store."""
    store, own = service.store_pid(), {client.pid for client in clients}
    kept = plant.parent(store)
    server = [pid for pid in [service.pid, *plant.children(service.pid)] if pid not in {store, kept, *own}]
    return {
        "server": sum(map(plant.resident, server)),
        "store": plant.resident(store),
        "server_cpu_s": sum(map(plant.cpu_seconds, server)),
        "store_cpu_s": plant.cpu_seconds(store) + plant.cpu_seconds(kept),
        "threads": sum(1 for _ in Path(f"/proc/{service.pid}/task").iterdir()),
        "files": sum(1 for _ in Path(f"/proc/{service.pid}/fd").iterdir()),
    }


def _trend(rows: Sequence[dict[str, float]], name: str) -> dict[str, float]:
    """Memory at the beginning and end [MB], and the slope of a line through the second half [MB a minute]."""
    values = np.array([row[name] for row in rows]) / 1e6
    at = np.array([row["at_s"] for row in rows]) / 60.0
    half = len(values) // 2
    slope = float(np.polyfit(at[half:], values[half:], 1)[0]) if len(values) - half > 2 else 0.0
    return {
        "first": round(float(values[0]), 1),
        "middle": round(float(values[half]), 1),
        "last": round(float(values[-1]), 1),
        "most": round(float(values.max()), 1),
        "slope_mb_a_minute": round(slope, 3),
    }


def _client(
    told: Any, begins: Any, url: str, robots: Sequence[int], starts: Any, seconds: float, rate: float
) -> None:
    """Some of the robots, each in a thread; tells that it is there, and at the end what it was answered."""
    import threading

    told.put({})
    wait_for(lambda: begins.value > 0.0, 300.0, "the beginning")
    began, statuses, took = begins.value, Counter[str](), list[tuple[float, float]]()
    threads = [
        threading.Thread(target=_drive, args=(url, i, starts, began, seconds, rate, statuses, took))
        for i in robots
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(seconds + 120.0)
    told.put({"statuses": dict(statuses), "took": took})


def _drive(
    url: str,
    number: int,
    starts: Sequence[Sequence[float]],
    began: float,
    seconds: float,
    rate: float,
    statuses: Counter[str],
    took: list[tuple[float, float]],
) -> None:
    """Episode after episode, each closed when its rule is settled; the server keeps it or archives it."""
    time.sleep(
        max(0.0, began - time.monotonic()) + random.Random(number).random() * (1.0 / rate if rate else 0.1)
    )
    episode = 0
    with httpx.Client(base_url=url, timeout=30.0, trust_env=False, verify=False) as http:
        while time.monotonic() < began + seconds:
            seed = 1000 * number + episode
            pose, t, status = starts[seed % len(starts)], 0, "pending"
            begun = {"policy_id": POLICY, "initial_pose": pose, "seed": seed}
            made = http.post("/v1/sessions", json=begun)
            statuses[str(made.status_code)] += 1
            if made.status_code != 201:
                time.sleep(0.5)
                continue
            path = f"/v1/sessions/{made.json()['id']}"
            while status == "pending" and time.monotonic() < began + seconds:
                body = {"t": t, "poses": [pose], "logits": logits_of(seed, t)}
                asked = time.monotonic()
                answer = http.post(f"{path}/steps", json=body)
                ended = time.monotonic()
                took.append((asked - began, ended - asked))
                statuses[str(answer.status_code)] += 1
                if answer.status_code != 200:
                    break
                decision = answer.json()
                pose, status, t = decision["next_poses"][decision["action"]], decision["spec_status"], t + 1
                if rate:
                    time.sleep(max(0.0, asked + 1.0 / rate - time.monotonic()))
            statuses[str(http.post(f"{path}/close", json={"t": t, "poses": [pose]}).status_code)] += 1
            episode += 1
