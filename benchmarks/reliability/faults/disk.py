"""The row in which the disk is full."""

from __future__ import annotations

import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx

from benchmarks.reliability.faults.crowd import Crowd
from benchmarks.reliability.faults.kills import Scene
from benchmarks.reliability.figures import spread
from benchmarks.reliability.plant import Service, small_disk, wait_for

MEGABYTES = 200  # the server keeps 64 free for sessions that run
FULL = 1.5  # [s] that the disk stays full
HOLDING = 1 << 20  # bytes a write of the file that fills the disk


def disk_full(scene: Scene) -> dict[str, Any]:
    """The data folder's disk, a tmpfs of 200 MB, filled by a foreign file for 1.5 s and freed again, while
    robots drive and maps are sent. away: from its being freed. server_errors: answers of 500.
    """
    refused, late = Counter[int](), list[float]()
    with (
        small_disk(scene.folder / "disk", MEGABYTES) as disk,
        Service(disk / "data") as service,
        httpx.Client(base_url=service.url, timeout=30.0, trust_env=False) as http,
    ):
        with Crowd([service.url], scene.starts, 4) as crowd:
            for i in range(scene.n):
                _fill(disk / "filler")
                ends = time.monotonic() + FULL
                while time.monotonic() < ends:
                    with suppress(httpx.TransportError):
                        refused[http.post("/v1/maps", json=_map(i)).status_code] += 1
                        began = time.monotonic()
                        refused[http.get("/readyz").status_code] += 1
                        late.append(time.monotonic() - began)
                    time.sleep(0.1)
                crowd.fault((disk / "filler").unlink)
                wait_for(lambda: http.get("/readyz").status_code == 200, 60.0, "ready again")
        found = crowd.result(service.url, scene.reference)
    told = {str(status): count for status, count in sorted(refused.items())}
    errors = refused[500] + crowd.statuses()[500]
    return {
        "times_full": scene.n,
        **found,
        "answers_while_full": told,
        "readyz_s": spread(late),
        "server_errors": errors,
    }


def _fill(path: Path) -> None:
    """A file that takes all the room there is."""
    with open(path, "wb", buffering=0) as file:
        for size in (HOLDING, 1 << 12, 1):
            with suppress(OSError):
                while file.write(bytes(size)) == size:
                    pass


def _map(i: int) -> dict[str, Any]:
    """A map of 100 x 100 cells, another for each i."""
    origin = {
        "position": {"x": float(i), "y": 0.0, "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    info = {"resolution": 0.1, "width": 100, "height": 100, "origin": origin}
    return {"format": "occupancy_grid", "info": info, "data": [0] * 10_000}
