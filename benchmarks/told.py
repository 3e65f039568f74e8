"""What bounds look-ahead with a model that has to search: what it would cost if the goal were told.

    python -m benchmarks.told [--cases 1,2] [--runs 200] [--seed 11]

The learned model, as in `specshield evaluate --model learned`: KL and extra steps of look-ahead as shares of
the projection's, over the same runs. never: as it is. seen: look-ahead is certain of the target from the step
on at which the model first sees it, not before. start: from the beginning, when the model is not. Prints
Markdown.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from functools import lru_cache, partial
from multiprocessing import get_context

import numpy as np

from evaluation import runs
from evaluation.experiment import Experiment, experiments
from evaluation.runs import Record
from specshield.lookahead.belief import Belief
from specshield.lookahead.goals import cell_of
from specshield.lookahead.lookahead import prepare
from specshield.sim.learned.model import LearnedModel
from specshield.sim.robot import SimulatedRobot

WHEN = ("never", "seen", "start")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default="1,2")
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=11)
    args = parser.parse_args()
    print("| case | told | KL, share of the projection's | extra steps, share | rule satisfied |")
    print("| --- | --- | --: | --: | --: |")
    for case in args.cases.split(","):
        unmodified = _all(case, args.seed, args.runs, "unmodified", "never")
        ours = _all(case, args.seed, args.runs, "ours", "never")
        for when in WHEN:
            told = _all(case, args.seed, args.runs, "lookahead", when)
            kl = np.mean([r.kl for r in told]) / np.mean([r.kl for r in ours])
            steps = _extra(told, unmodified) / _extra(ours, unmodified)
            kept = sum(r.satisfied for r in told)
            print(f"| {case} | {when} | {kl:.2f} | {steps:.2f} | {kept} of {args.runs} |", flush=True)


def _extra(records: list[Record], unmodified: list[Record]) -> float:
    """Mean steps added to the main task, over the runs that do it with and without."""
    pairs = [(a.ended_at, b.ended_at) for a, b in zip(records, unmodified, strict=True)
             if a.main_done and b.main_done]  # fmt: skip
    return float(np.mean([(a or 0) - (b or 0) for a, b in pairs]))


def _all(case: str, seed: int, count: int, method: str, when: str) -> list[Record]:
    with get_context("spawn").Pool(os.cpu_count()) as pool:
        return pool.map(partial(_run, case, seed, method, when), range(count), chunksize=5)


def _run(case: str, seed: int, method: str, when: str, i: int) -> Record:
    return runs.run(_experiment(case, seed, when), i, [method])[0]


@lru_cache(maxsize=1)
def _experiment(case: str, seed: int, when: str) -> Experiment:
    experiment = experiments(case, None, "learned", "none", seed)[0]
    if when != "never":
        _tell(experiment, when == "start")
    return experiment


def _tell(experiment: Experiment, from_start: bool) -> None:
    """In this process, which is of one pool: what is believed is replaced by what is so."""
    setting = experiment.setting
    ahead = prepare(setting.case.task, setting.ours.proposers)
    goals = ahead.bank.goals
    row, column = cell_of(goals, *setting.case.target)
    around = goals.distance[
        :, max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4
    ]  # it is on furniture
    known = np.zeros(len(goals.distance) + 1)
    known[int(around.min(axis=(1, 2)).argmin())] = 1.0
    told = from_start
    reset, logits = LearnedModel.reset, LearnedModel.logits
    believed, trusted = Belief.probabilities, Belief.trust.fget  # type: ignore[attr-defined]

    def forget(self: LearnedModel, random: np.random.Generator) -> None:
        nonlocal told
        told = from_start
        reset(self, random)

    def look(self: LearnedModel, robot: SimulatedRobot) -> np.ndarray:
        nonlocal told
        told = told or robot.sense().seen
        return logits(self, robot)

    probabilities: Callable[[Belief], np.ndarray] = lambda self: known if told else believed(self)  # noqa: E731
    LearnedModel.reset, LearnedModel.logits = forget, look  # type: ignore[method-assign]
    Belief.probabilities = probabilities  # type: ignore[method-assign]
    Belief.trust = property(lambda self: 1.0 if told else trusted(self))  # type: ignore[assignment]


if __name__ == "__main__":
    main()
