"""Decisions as digests, so that two commits can be compared to the last bit.

    python -m benchmarks.digests                  # decides the same steps again and compares
    python -m benchmarks.digests --write          # records benchmarks/digests.json
    python -m benchmarks.digests --only planner   # some of the settings
    python -m benchmarks.digests --steps FILE     # every step's digest, to find the first that differs

An episode's digest covers every field of every decision of it, with every action's witness. The episodes are
of the goal-seeking model; each begins at a random pose, feasible or not, and its draws follow the seed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.rules import RULES
from benchmarks.rules import make as make_rule
from evaluation.shipped import shipped
from specshield.episode import Config, Decision, Shield, decide, make_shield
from specshield.lookahead.lookahead import prepare
from specshield.policy.dqn.environment import free_poses
from specshield.policy.planner import policy as planner
from specshield.robot import STRETCH
from specshield.sim.cases import Case, load_case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import SimulatedRobot

FILE = Path(__file__).with_suffix(".json")
STEPS = 2_000  # decisions of each setting, at least
FEW = 400  # of those whose decisions take long
NOISE = (0.02, np.radians(1.0))  # [m], [rad] of the disturbed settings
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Setting:
    """A case, a method and a session's settings. disturbed: the robot is not where f leads."""

    name: str
    case: str
    method: str
    config: Config = field(default_factory=Config)
    disturbed: bool = False
    steps: int = STEPS


def settings() -> list[Setting]:
    found = []
    for case in ("case1", "case2"):
        exact = ("reachability", "dqn", "dqn-literal", "planner")
        found += [Setting(f"{case} {method}", case, method) for method in exact]
        wary = Config(margin=0.04, slack=8)
        for method in ("reachability", "dqn", "planner"):
            steps = FEW if method == "planner" else STEPS
            found.append(Setting(f"{case} {method}, disturbed", case, method, Config(), True, steps))
            found.append(Setting(f"{case} {method}, margin and slack", case, method, wary, True, steps))
        found.append(Setting(f"{case} lookahead", case, "lookahead"))
        values = Config(evaluation="robustness", threshold=0.05)
        found.append(Setting(f"{case} robustness", case, "reachability", values, False, FEW))
        found.append(Setting(f"{case} threshold", case, "reachability", Config(threshold=0.9), False, FEW))
    found += [Setting(f"rule {name}", RULES[name][0], f"rule {name}") for name in RULES]
    return found


def shield_of(setting: Setting) -> tuple[Case, Shield]:
    if setting.method.startswith("rule "):
        case, policy = make_rule(setting.method.removeprefix("rule "))
        return case, make_shield([policy], setting.config)
    case = load_case(setting.case)
    if setting.method == "planner":
        return case, make_shield([planner.synthesise(case.task)], setting.config)
    if setting.method == "lookahead":
        computed = [shipped(case, "reachability")]
        return case, make_shield(computed, setting.config, prepare(case.task, computed))
    learned: Any = shipped(case, setting.method.removesuffix("-literal"))
    if setting.method.endswith("-literal"):
        learned = replace(learned, literal=True)
    return case, make_shield([learned], setting.config)


def episodes(setting: Setting, seed: int) -> Iterator[list[str]]:
    """The digests of each episode's decisions, until there are enough of them."""
    case, shield = shield_of(setting)
    made, episode = 0, 0
    while made < setting.steps:
        random = np.random.default_rng([seed, episode])
        found = list(run(case, replace(shield, config=replace(shield.config, seed=episode)), random, setting))
        made, episode = made + len(found), episode + 1
        yield found


def run(case: Case, shield: Shield, random: np.random.Generator, setting: Setting) -> Iterator[str]:
    """One episode to the horizon. It goes on after the model's `end`, without logits."""
    task = shield.task
    start = free_poses(task, shield.body, 1, random)[0]
    robot, model = SimulatedRobot(case, tuple(start.tolist())), GoalSeeker(STRETCH)
    model.reset(random)
    poses, events, carry, over = [start], list[float](), None, False
    rise = int(random.integers(5, 60))
    for t in range(task.horizon + 1):
        signals = {}
        if task.signals:
            events.append(float(t >= rise))
            signals = {"event": np.array(events)}
        logits = None if over else model.logits(robot)
        decision = decide(shield, poses, logits, over, signals, carry, True)
        yield digest(decision)
        carry, action = decision.carry, decision.action
        over = over or bool(STRETCH.terminal[action])
        if over:
            action = 0 if decision.completion_action is None else decision.completion_action
        robot.execute(action)
        if setting.disturbed:
            x, y = robot.pose[:2] + random.normal(0.0, NOISE[0], 2)
            robot.pose = (float(x), float(y), robot.pose[2] + random.normal(0.0, NOISE[1]))
        poses.append(np.array(robot.pose))


def digest(decision: Decision) -> str:
    """Of every field but what is handed on, in hex. What was added to the contract later is left out."""
    content = repr([(name, _plain(getattr(decision, name))) for name in FIELDS])
    return hashlib.sha256(content.encode()).hexdigest()[:16]


LATER = (
    "carry", "warnings", "margin", "slack", "threshold_left", "map_revision", "any_signal", "explanations",
)  # fmt: skip
FIELDS = sorted({*Decision._fields} - {*LATER})


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def of_setting(setting: Setting, seed: int) -> dict[str, Any]:
    every = list(episodes(setting, seed))
    joined = [hashlib.sha256("".join(found).encode()).hexdigest()[:16] for found in every]
    return {"decisions": sum(map(len, every)), "episodes": joined, "steps": every}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.digests", description=__doc__)
    parser.add_argument("--write", action="store_true", help="record instead of compare")
    parser.add_argument("--only", default="", help="settings with this in their name")
    parser.add_argument("--steps", type=Path, help="write every decision's digest to this file")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(arguments)
    known = {} if asked.write and not FILE.exists() else json.loads(FILE.read_text())
    found, every, differ = dict(known), {}, 0
    chosen = [setting for setting in settings() if asked.only in setting.name]
    if not chosen:
        parser.error(f"no setting has {asked.only!r} in its name")
    for setting in chosen:
        made = of_setting(setting, asked.seed)
        every[setting.name] = made.pop("steps")
        found[setting.name] = made
        same = known.get(setting.name) == made
        differ += not same
        said = "recorded" if asked.write else "the same" if same else "DIFFERS"
        print(f"{setting.name}: {made['decisions']} decisions, {said}", file=sys.stderr, flush=True)
    if asked.write:
        FILE.write_text(json.dumps(found, indent=0) + "\n")
    if asked.steps:
        asked.steps.write_text(json.dumps(every))
    return 0 if asked.write else min(differ, 1)


if __name__ == "__main__":
    sys.exit(main())
