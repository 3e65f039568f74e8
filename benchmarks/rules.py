"""Rules beyond the fragment of tables: a rule of each shape in the case apartments, kept by the planner.

    python -m benchmarks.rules [--runs 20] [--seed 0]

Episodes of the goal-seeking model behind the shield, from random feasible starts; of a reactive rule the
event rises at a random step and stays. Prints Markdown: how many episodes kept the rule, how many starts were
refused, the processor time of a decision, and recall: of the (history, action) pairs that are certified with
the witness carried or by plans of REFERENCE times the effort, the share that the planner certifies on its
own. (tests/policy/planner/test_planner.py has the recall against every future, on small worlds.)
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from specshield.episode import Carry, Config, Shield, close, decide, make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.policy.planner.method import Settings
from specshield.policy.planner.policy import PlannerPolicy, synthesise
from specshield.robot import STRETCH
from specshield.sim.cases import Case, load_case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import SimulatedRobot
from specshield.task import make_task

REFERENCE = 30
EVERY = 10  # steps between the states at which recall is measured
EVENT = {"event": 0.0}
RULES = {
    "patrol": ("case2", "G[0,100] F[0,50] Region1 and G[0,100] F[0,50] Region2"),
    "reactive": ("case2", "G[0,100] (event > 0.5 -> F[0,60] Region2) and G[0,150] not Forbidden"),
    "until": ("case2", "not Region2 U[0,100] Region1 and F[50,140] Region2"),
    "until, round what is in the way": ("case2", "not Region1 U[0,140] Region2"),
    "disjunction": (
        "case2",
        "(F[0,100] Region1 and F[0,100] Region2 or F[0,100] G[0,20] Region3) and G[0,120] not Forbidden",
    ),
    "dwell": ("case2", "F[0,80] G[0,10] Region1 and F[80,140] G[0,5] Region3"),
    "nested": (
        "case2",
        "G[0,80] (Region1 -> F[0,60] Region2) and F[0,60] Region1 "
        "and F[20,140] (Region3 and F[0,40] not Region3)",
    ),
    "patrol of two ends": ("case1", "G[0,100] F[0,110] Charger1 and G[0,100] F[0,110] Charger2"),
}


@dataclass
class Episode:
    """poses: x_0 to x_T; events [T + 1]; spec_status: the shield's verdict; ms: of each decision."""

    poses: list[NDArray[np.float64]]
    events: list[float] = field(default_factory=list)
    spec_status: str = "pending"
    modes: Counter[str] = field(default_factory=Counter)
    ms: list[float] = field(default_factory=list)
    feasible: list[tuple[int, int]] = field(default_factory=list)  # certified at once, certified in any way

    def signals(self) -> dict[str, NDArray[np.float64]]:
        return {"event": np.array(self.events)} if self.events else {}


def make(name: str) -> tuple[Case, PlannerPolicy]:
    """A rule's case and its planner."""
    of, formula = RULES[name]
    case = load_case(of)
    signals = EVENT if "event" in formula else {}
    task = make_task(case.task.grid, STRETCH, formula, case.spec["regions"], case.rooms, signals)
    return case, synthesise(task)


def feasible_starts(
    shield: Shield, random: np.random.Generator, refused: list[NDArray[np.float64]]
) -> Iterator[NDArray[np.float64]]:
    while True:
        pose = free_poses(shield.task, shield.body, 1, random)[0]
        try:
            start(shield, pose)
        except InfeasibleStart:
            refused.append(pose)
            continue
        yield pose


def run(
    shield: Shield, case: Case, pose: NDArray[np.float64], seed: int, reference: Shield | None = None
) -> Episode:
    """One episode of the goal seeker from `pose`; it goes on after its `end` until the rule is decided."""
    task, random = shield.task, np.random.default_rng(seed)
    model, robot = GoalSeeker(STRETCH), SimulatedRobot(case, (float(pose[0]), float(pose[1]), float(pose[2])))
    model.reset(random)
    episode, carry, done = Episode([pose]), None, False
    rise = int(random.integers(5, 60))
    for t in range(task.horizon):
        if task.signals:
            episode.events.append(float(t >= rise))
        logits = None if done else model.logits(robot)
        began = time.thread_time()
        decision = decide(shield, episode.poses, logits, done, episode.signals(), carry)
        episode.ms.append(1e3 * (time.thread_time() - began))
        episode.modes[decision.mode] += 1
        if reference is not None and t % EVERY == 0 and decision.mode in ("shaped", "completion"):
            episode.feasible.append(_recall(shield, reference, episode, carry))
        carry, action = decision.carry, decision.action
        if STRETCH.terminal[action]:
            done = True
            if decision.completion_action is None:
                break
            action = decision.completion_action
        robot.execute(action)
        episode.poses.append(np.array(robot.pose))
    still = task.horizon + 1 - len(episode.poses)
    episode.poses += [episode.poses[-1]] * still
    if episode.events:
        episode.events += [episode.events[-1]] * (task.horizon + 1 - len(episode.events))
    episode.spec_status = close(shield, episode.poses, episode.signals())[0]
    return episode


def _recall(shield: Shield, reference: Shield, episode: Episode, carry: Carry | None) -> tuple[int, int]:
    motions = STRETCH.representative
    args = (episode.poses, None, True, episode.signals())
    alone = np.array(decide(shield, *args).j_values, float)[motions] == 1.0
    most = np.array(decide(reference, *args, carry).j_values, float)[motions] == 1.0
    return int(alone.sum()), int((alone | most).sum())


def measure(name: str, runs: int, seed: int) -> Mapping[str, object]:
    case, policy = make(name)
    shield = make_shield([policy], Config(seed=seed))
    more = replace(policy, settings=Settings(policy.settings.pitch, REFERENCE * policy.settings.effort))
    reference = make_shield([more])
    refused: list[NDArray[np.float64]] = []
    starts = feasible_starts(shield, np.random.default_rng(seed), refused)
    episodes = [run(shield, case, next(starts), seed + i, reference) for i in range(runs)]
    ms = np.concatenate([episode.ms for episode in episodes])
    alone, most = np.sum([pair for episode in episodes for pair in episode.feasible], axis=0)
    kept = sum(episode.spec_status == "satisfied" for episode in episodes)
    modes = sum((episode.modes for episode in episodes), Counter())
    return {
        "rule": name,
        "T": policy.task.horizon,
        "made in": f"{policy.card['metrics']['wall_time_s']:.1f} s",
        "MB": f"{policy.card['metrics']['size_bytes'] / 1e6:.1f}",
        "kept": f"{kept} of {runs}",
        "refused": len(refused),
        "fallbacks": modes["fallback"],
        "p50, p99, max [ms]": ", ".join(f"{v:.1f}" for v in (*np.percentile(ms, (50, 99)), ms.max())),
        "recall": f"{alone / most:.3f} of {most}",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    for i, name in enumerate(RULES):
        row = measure(name, asked.runs, asked.seed)
        if i == 0:
            print("| " + " | ".join(row) + " |")
            print("|" + "---|" * len(row))
        print("| " + " | ".join(str(value) for value in row.values()) + " |", flush=True)


if __name__ == "__main__":
    main()
