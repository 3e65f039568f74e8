"""Runs in worlds that differ from the description, in several processes, a file for each, and their table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.evaluation import add_lines, finished, workers
from evaluation.statistics import clopper_pearson
from evaluation.worlds.runs import Outcome, Trial, run
from specshield.sim.campaign import each_done

HEAD = (
    "| robot | case | world | senses | kept of what the oracle can keep | 95 % interval | oracle | "
    "changed the map, p50 / p99 [ms] | KL | slack |\n|---|---|---|---|---|---|---|---|--:|--:|"
)


def compare(trials: Sequence[Trial], runs: int, out: Path | None, processes: int) -> None:
    """Prints a row of the table for each trial as it is done. out: a folder; what it holds is kept."""
    print(HEAD, flush=True)
    for trial in trials:
        print(row(trial, outcomes(trial, runs, out, processes)), flush=True)


def outcomes(trial: Trial, runs: int, out: Path | None, processes: int) -> list[Outcome]:
    """Runs 0 to `runs` - 1 of a trial, those that were kept before among them."""
    file = None if out is None else out / f"{'-'.join(_parts(trial))}.jsonl"
    kept = [] if file is None else finished(file, lambda kept: Outcome(**kept))
    done = {outcome.run: outcome for outcome in kept}
    for outcome in _made(trial, [i for i in range(runs) if i not in done], processes):
        done[outcome.run] = outcome
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            add_lines(file, [outcome.to_json()])
    return [done[i] for i in range(runs)]


def _parts(trial: Trial) -> list[str]:
    """What tells a trial's file from others; a house by its file's name, so that it lies in the folder."""
    return [Path(trial.case).name, *(str(value) for value in list(asdict(trial).values())[1:])]


def _made(trial: Trial, missing: Sequence[int], processes: int) -> Iterator[Outcome]:
    if processes == 1 or len(missing) < 2:
        yield from (run(trial, i) for i in missing)
        return
    with workers(processes) as pool:
        for _, outcome in each_done(pool.submit(run, trial, i) for i in missing):
            yield outcome


def figures(found: Sequence[Outcome]) -> dict[str, Any]:
    """kept: of `could`, the runs that the oracle can keep. low, high: the 95 % interval of their share.
    p50, p99 [ms]: of all decisions that changed the map. kl [nats]: of a run from the model's own, the mean.
    """
    could = [outcome for outcome in found if outcome.could]
    kept = sum(outcome.kept for outcome in could)
    low, high = clopper_pearson(kept, len(could)) if could else (0.0, 1.0)
    spent = [ms for outcome in found for ms in outcome.changed_ms]
    p50, p99 = np.percentile(spent, [50, 99]).round(1).tolist() if spent else (None, None)
    return {
        "kept": kept,
        "could": len(could),
        "runs": len(found),
        "low": low,
        "high": high,
        "p50": p50,
        "p99": p99,
        "kl": float(np.mean([outcome.kl for outcome in found])),
    }


def row(trial: Trial, found: Sequence[Outcome]) -> str:
    got = figures(found)
    slack = "learned" if trial.uncertain else str(trial.slack)
    changed = "-" if got["p50"] is None else f"{got['p50']} / {got['p99']}"
    return (
        f"| {trial.robot} | {trial.case} | {trial.world} | {trial.sensing} | "
        f"{got['kept']} of {got['could']} | {100 * got['low']:.1f} to {100 * got['high']:.1f} % | "
        f"{got['could']} of {got['runs']} | "
        f"{changed} | {got['kl']:.0f} | {slack} |"
    )
