"""What a decision costs along whole episodes, near deadlines too: every one of them, in CPU time.

    python -m benchmarks.episodes                    # cases 1 and 2, the shipped policies, 60 starts each
    python -m benchmarks.episodes --against PATH     # this checkout and another, held against each other
    python -m benchmarks.episodes --states FILE      # each state's milliseconds too, to find the slow ones

The learned model that is shipped acts, the shield decides, and the robot does what is drawn, until the rule
is decided; what comes after takes next to nothing and would hide the slow decisions. Each state is decided
again with the same carry, and the fewest milliseconds of CPU count, since the machine is shared. With
--against each state is asked of two processes in turn, one a checkout, so that both meet the same machine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.states import starts
from benchmarks.timing import one_core, summary
from evaluation.shipped import shipped
from specshield.episode import Decision, Shield, decide, make_shield
from specshield.sim.cases import Case, load_case
from specshield.sim.learned.model import load_learned
from specshield.sim.robot import SimulatedRobot

HERE = Path(__file__).resolve().parents[1]
ROUNDS, REPEATS = 3, 2  # each state is asked of each checkout ROUNDS times, REPEATS decisions a time
SHOWN = ("p50", "p90", "p99", "max")


@dataclass(frozen=True)
class Asked:
    """What one decision is asked. near: whether S_t leaves out an action, as it does near a deadline."""

    pose: list[float]
    logits: list[float] | None
    over: bool
    first: bool
    near: bool

    def to_json(self) -> dict[str, Any]:
        return {"pose": self.pose, "logits": self.logits, "over": self.over, "first": self.first}


def driven(case: Case, shield: Shield, count: int, seed: int) -> Iterator[tuple[Any, ...]]:
    """Every state of `count` episodes at which the rule is pending: the poses so far [t + 1, 3], logits [A],
    whether the main task is over, the carry, and what was decided of them.
    """
    model, terminal = load_learned(case.instruction), case.task.robot.terminal
    for episode, begun in enumerate(starts(shield, count, seed)):
        robot = SimulatedRobot(case, tuple(begun.history[0].tolist()))
        model.reset(np.random.default_rng([seed, episode]))
        poses, over, carry = [robot.pose], False, None
        while len(poses) <= case.task.horizon:
            logits = None if over else model.logits(robot)
            decision = decide(shield, poses, logits, over, carry=carry)
            if decision.spec_status != "pending":
                break
            yield np.array(poses), logits, over, carry, decision
            over = over or bool(terminal[decision.action])
            robot.execute(decision.completion_action if over else decision.action)
            poses.append(robot.pose)
            carry = decision.carry


def episodes(case: Case, shield: Shield, count: int, seed: int) -> Iterator[Asked]:
    for poses, logits, over, _, decision in driven(case, shield, count, seed):
        told = None if logits is None else logits.tolist()
        near = is_near(decision, case.task.robot.terminal)
        yield Asked(poses[-1].tolist(), told, over, len(poses) == 1, near)


def is_near(decision: Decision, terminal: np.ndarray[Any, np.dtype[np.bool_]]) -> bool:
    return any(j != 1.0 for j, ends in zip(decision.j_values, terminal, strict=True) if not ends)


class Answerer:
    """A process of a checkout that decides what it is told, and times it."""

    def __init__(self, checkout: Path, case: str, method: str) -> None:
        env = {**os.environ, "PYTHONPATH": str(checkout / "app")}
        if checkout != HERE:  # two versions that share a folder clear each other's kernels
            env["NUMBA_CACHE_DIR"] = str(checkout / ".numba")
        command = [sys.executable, "-P", str(HERE / "benchmarks" / "answerer.py"), case, method]
        self._process = subprocess.Popen(
            command, env=env, cwd=checkout, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def close(self) -> None:
        self._process.communicate()

    def ask(self, said: dict[str, Any]) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(said), file=self._process.stdin, flush=True)
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer


def measure(case_name: str, method: str, checkouts: Sequence[Path], count: int, seed: int) -> dict[str, Any]:
    """Seconds of each state in each checkout [checkouts][states], which are near, how many were not decided
    alike.
    """
    case = load_case(case_name)
    states = list(episodes(case, make_shield([shipped(case, method)]), count, seed))
    seconds, differ = np.full((len(checkouts), len(states)), np.inf), 0
    answerers = [Answerer(checkout, case_name, method) for checkout in checkouts]
    for i, state in enumerate(states):
        differ += len({each.ask(state.to_json())["digest"] for each in answerers}) > 1
        for _ in range(ROUNDS):
            for n, each in enumerate(answerers):
                seconds[n, i] = min(seconds[n, i], 1e-9 * each.ask({"repeats": REPEATS})["ns"])
    for each in answerers:
        each.close()
    return {"seconds": seconds.tolist(), "near": [state.near for state in states], "differ": differ,
            "first": [state.first for state in states]}  # fmt: skip


def show(name: str, found: dict[str, Any]) -> None:
    """One line a checkout, for all states, the first ones, and those near a deadline, then the ratio of the
    first two.
    """
    near, first = np.array(found["near"]), np.array(found["first"])
    for part, chosen in (
        ("all", np.ones(len(near), bool)),
        ("first steps", first),
        ("near a deadline", near),
    ):
        rows = [summary(np.array(each)[chosen]) for each in found["seconds"] if chosen.any()]
        for n, row in enumerate(rows):
            figures = "  ".join(f"{key} {row[key]:.3f}" for key in SHOWN)
            whose = "this" if n == 0 else "other"
            print(f"{name}, {part} ({chosen.sum()} of {len(near)}), {whose}: {figures} ms")
        if len(rows) == 2:
            ratios = "  ".join(f"{key} {rows[0][key] / rows[1][key]:.3f}" for key in SHOWN)
            total = sum(np.array(found["seconds"][0])[chosen]) / sum(np.array(found["seconds"][1])[chosen])
            unlike = f"{found['differ']} decided unlike"
            print(f"{name}, {part}, this / other: {ratios}  mean {total:.3f}; {unlike}")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.episodes", description=__doc__)
    parser.add_argument("--against", type=Path, help="another checkout; its kernels are kept in its .numba/")
    parser.add_argument("--case", action="append", help="case1 or case2; both where it is left out")
    parser.add_argument("--method", action="append", help="reachability or dqn; both where it is left out")
    parser.add_argument("--episodes", type=int, default=60, help="of each case and policy")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--states", type=Path, help="write each state's figures to this file, as JSON")
    asked = parser.parse_args()
    one_core()
    checkouts = [HERE] if asked.against is None else [HERE, asked.against.resolve()]
    every = {}
    for case in asked.case or ("case1", "case2"):
        for method in asked.method or ("reachability", "dqn"):
            name = f"{case} {method}"
            every[name] = measure(case, method, checkouts, asked.episodes, asked.seed)
            show(name, every[name])
    if asked.states:
        asked.states.write_text(json.dumps(every))


if __name__ == "__main__":
    main()
