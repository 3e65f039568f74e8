"""Episodes in which the service is away for a while, under `on_failure="witness"`: is the rule kept?

    python -m benchmarks.away [--episodes 100] [--steps 30] [--seed 0] [--cases case1 case2]

A real server over HTTP, and a network of the robot's that is cut at a random step of the rule's time, for
`--steps` steps; in every other episode it delivers requests and loses the answers instead. The robot's clock
is 0.2 s a step, so that the client's pauses between two questions are those of a robot. Exit status 1 if a
rule was not kept.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Iterator

import httpx
import numpy as np

from specshield.client import LocalDecision, ShieldClient
from specshield.client.network.bounded import Transport
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.sim.cases import Case, load_case
from specshield.sim.learned.model import load_learned
from specshield.sim.robot import Pose, SimulatedRobot
from specshield.sim.service import own_server

STEP = 0.2  # [s] that a step takes the robot; chosen by hand


class Network(Transport):
    """A way to the server that can be cut: nothing arrives, or (`deaf`) nothing comes back."""

    cut = deaf = False

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        if self.cut and not self.deaf:
            raise httpx.ConnectError("the network is cut", request=request)
        response = super().handle_request(request)
        if self.cut:
            response.read()
            response.close()
            raise httpx.ReadTimeout("the answer was lost", request=request)
        return response


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100, help="of each case")
    parser.add_argument("--steps", type=int, default=30, help="for which the service is away")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", nargs="+", default=["case1", "case2"])
    asked = parser.parse_args()
    kept = True
    with own_server() as url:
        print(f"away for {asked.steps} steps, seed {asked.seed}, load {os.getloadavg()[0]:.1f}")
        for name in asked.cases:
            counts = campaign(url, load_case(name), asked.episodes, asked.steps, asked.seed)
            print(f"{name}: {counts['satisfied']} of {counts['episodes']} satisfied", flush=True)
            for what, n in sorted(counts.items()):
                print(f"    {n:7d}  {what}", flush=True)
            kept = kept and counts["satisfied"] == counts["episodes"] == asked.episodes
    return 0 if kept else 1


def campaign(url: str, case: Case, episodes: int, steps: int, seed: int) -> Counter[str]:
    """What happened, by name."""
    counts: Counter[str] = Counter()
    random = np.random.default_rng([seed, 40])
    model = load_learned(case.instruction)
    for start in starts(case, seed):
        begins = int(random.integers(1, case.task.horizon))
        network = Network(httpx.URL(url))
        network.deaf = counts["episodes"] % 2 == 1
        with ShieldClient(url, timeout=30.0, transport=network) as client:
            try:
                session = client.sessions.create(
                    policy_id=case.name, initial_pose=start, seed=seed, on_failure="witness"
                )
            except InfeasibleStart:
                counts["starts refused"] += 1
                continue
            robot, asked, last = SimulatedRobot(case, start), 0, "service"
            session._circuit.clock = lambda: STEP * asked  # noqa: B023
            model.reset(np.random.default_rng([seed, counts["episodes"]]))
            while not session.finished:
                network.cut = begins <= asked < begins + steps
                logits = None if session.main_task_done else model.logits(robot)
                decision = session.step(robot.pose, logits)
                asked += 1
                counts[f"steps by {decision.source}"] += 1
                if isinstance(decision, LocalDecision):
                    if decision.source == "stop":
                        counts[f"stopped: {decision.reason.lstrip('0123456789. ')[:60]}"] += 1
                elif last != "service":
                    counts[f"rejoined in mode {decision.mode} {decision.reason or ''}".rstrip()] += 1
                last = decision.source
                if decision.execute is not None and not session.finished:
                    robot.execute(decision.execute)
            network.cut = False
            verdict = session.close(robot.pose)
        counts["episodes"] += 1
        counts[verdict.spec_status] += 1
        counts["main tasks done"] += robot.at_target
        if counts["episodes"] == episodes:
            return counts
    return counts


def starts(case: Case, seed: int) -> Iterator[Pose]:
    """Free poses of the case's map, without end."""
    random = np.random.default_rng([seed, 41])
    while True:
        yield from map(tuple, free_poses(case.task, case.body, 50, random).tolist())


if __name__ == "__main__":
    sys.exit(main())
