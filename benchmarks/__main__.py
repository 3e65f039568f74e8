"""`make bench`: measures, and writes docs/benchmarks.md, its plots and its figures as JSON.

make bench                  # a few minutes
make bench ARGS=--full      # more states, longer sweeps
make bench ARGS=--sb3       # and a race between our DQN and stable-baselines3's, minutes each
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks import cold, decisions, report, service, sweep, synthesis, timing
from specshield.sim.cases import case_names

QUICK = {"n": 100, "episodes": 2, "plain": 4, "repeats": 3, "sweep": 100}
FULL = {"n": 1000, "episodes": 20, "plain": 30, "repeats": 3, "sweep": 300}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument("--full", action="store_true", help="more states")
    parser.add_argument("--sb3", action="store_true", help="race our DQN and stable-baselines3's")
    parser.add_argument("--minutes", type=float, default=5.0, help="of each in the race")
    parser.add_argument("--rate", type=float, default=0.95, help="satisfaction rate that wins the race")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parents[1] / "docs", help="folder to write to"
    )
    args = parser.parse_args()
    folder = args.out / "benchmarks"
    folder.mkdir(parents=True, exist_ok=True)
    command = f"make bench ARGS='{'--full ' if args.full else ''}--seed {args.seed}'"

    if args.sb3:  # a run of its own: the figures of the last one are kept
        say("race of the DQNs")
        race = synthesis.race("case1", args.rate, args.minutes, args.seed)
        race |= {"machine": timing.machine(), "command": f"make bench ARGS='--sb3 --seed {args.seed}'"}
        write(folder / "race.json", race)
    figures = measure(FULL if args.full else QUICK, args.seed) | {"command": command}
    write(folder / "figures.json", figures)
    report.write(args.out, figures, read(folder / "race.json"))
    print(f"{args.out / 'benchmarks.md'}")


def measure(size: dict[str, int], seed: int) -> dict[str, Any]:
    began = time.perf_counter()
    figures: dict[str, Any] = {"machine": timing.machine(), "size": size, "seed": seed}
    say("service")
    figures["service"] = service.measure(case_names(), size["repeats"], size["episodes"], seed)
    timing.one_core()
    torch.set_num_threads(1)
    say("synthesis")
    figures["synthesis"] = {name: synthesis.reach(name, size["repeats"]) for name in case_names()}
    say("first decisions")
    figures["cold"] = {method: cold.measure("case1", method) for method in ("dqn", "reachability")}
    figures["decisions"] = {}
    for name in case_names():
        say(f"decisions of {name}")
        args = (size["n"], size["episodes"], size["plain"], size["repeats"], seed)
        figures["decisions"][name] = decisions.compare(name, *args)
    say("horizons")
    figures["horizons"] = sweep.by_horizon(sweep.HORIZONS, size["sweep"], size["repeats"], seed)
    say("actions")
    figures["actions"] = sweep.by_actions(sweep.ACTIONS, size["sweep"], size["repeats"], seed)
    return figures | {"seconds": round(time.perf_counter() - began)}


def say(what: str) -> None:
    print(what, file=sys.stderr, flush=True)


def write(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n")


def read(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text()) if path.exists() else None


if __name__ == "__main__":
    main()
