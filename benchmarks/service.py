"""The service as a robot meets it: over HTTP, on one machine, the embedded store, one robot at a time."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.timing import summary
from specshield.client import ShieldClient
from specshield.policy.dqn.environment import free_poses
from specshield.shipped import MAPS
from specshield.sim.cases import Case, load_case
from specshield.sim.episodes import with_shield
from specshield.sim.learned.model import load_learned
from specshield.sim.service import own_server

ASKED_EVERY = 0.02  # [s] whether a policy is ready


def measure(names: list[str], repeats: int, episodes: int, seed: int) -> dict[str, Any]:
    """For each case: seconds from the POST of a policy till it is ready; milliseconds of a step, as the robot
    waits for it and as the server says.
    """
    with own_server(worker=True) as url, ShieldClient(url, timeout=10.0) as client:
        return {name: _case(client, load_case(name), repeats, episodes, seed) for name in names}


def _case(client: ShieldClient, case: Case, repeats: int, episodes: int, seed: int) -> dict[str, Any]:
    map_id = client.maps.upload(MAPS / f"{case.name}.yaml", MAPS / f"{case.name}.pgm").id
    ready = []
    for i in range(repeats):  # each under a seed of its own: another policy
        began = time.perf_counter()
        made = client.policies.create(map_id, case.spec["formula"], case.spec["regions"], seed=1 + i)
        client.policies.wait(made.id, timeout=300.0, interval=ASKED_EVERY)
        ready.append(time.perf_counter() - began)
    waited, served = list[float](), list[float]()
    model = load_learned(case.instruction)
    starts = free_poses(case.task, case.body, episodes, np.random.default_rng([seed, 30]))
    for i, (x, y, theta) in enumerate(starts.tolist()):
        session = client.sessions.create(
            policy_id=made.id, initial_pose=(x, y, theta), seed=seed, allow_infeasible=True
        )
        episode = with_shield(session, case, model, (x, y, theta), seed + i)
        waited += [1e-3 * ms for ms in episode.round_trip_ms]
        served += [1e-3 * ms for ms in episode.server_ms]
    return {"ready_s": ready, "round_trip": summary(waited), "server": summary(served)}
