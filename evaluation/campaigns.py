"""What `specshield evaluate` does: experiments one after another, each by several methods, in tables."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path

from evaluation import evaluation, results
from evaluation.calibration import calibrated
from evaluation.experiment import Experiment, certifies, split
from specshield.errors import SpecshieldError
from specshield.sim.progress import StatusLine, duration

WIDTH = 30  # characters of a progress bar


def evaluate(
    experiments: Sequence[Experiment],
    runs: int,
    methods: Sequence[str],
    out: Path | None,
    processes: int,
    redis_url: str | None,
    as_json: bool,
) -> int:
    """Prints a table an experiment, or with `as_json` its figures and every record.

    out: the folder of the results, with one folder an experiment; runs that are kept there already are not
    made again. Returns the exit status: 1 if a method that certifies its actions broke the rule in a world
    that was as it had been told. Raises what `split` and `evaluation.check` raise before the first run.
    """
    for name in methods:
        _check(name)
    folders = [None if out is None else out / e.setting.case.name / e.noise for e in experiments]
    for experiment, folder in zip(experiments, folders, strict=True):
        if folder is not None:
            evaluation.check(folder, experiment)
    broken = False
    for experiment, folder in zip(experiments, folders, strict=True):
        began = time.monotonic()
        chosen = [calibrated(experiment, name, folder, processes) for name in methods]
        progress = _Progress(f"{experiment.setting.case.name}, {experiment.noise}", runs)
        records = evaluation.evaluate(experiment, runs, chosen, folder, processes, redis_url, progress.show)
        progress.clear()
        figures = results.results(experiment, records)
        if folder is not None:
            results.write(folder)  # of all that the folder holds
        if as_json:
            print(json.dumps({**figures, "records": [record.to_json() for record in records]}))
        else:
            print(
                f"{progress.title}, model {experiment.model}, seed {experiment.seed}: {figures['formula']}\n"
            )
            print(f"{results.table(figures)}\n")
            kept = "" if folder is None else f"; {folder / 'table.md'} has all runs that are kept there"
            print(f"{duration(time.monotonic() - began)}{kept}")
        broken |= experiment.noise == "none" and any(
            not record.satisfied and certifies(record.method) for record in records
        )
    return 1 if broken else 0


def _check(method: str) -> None:
    """Raises what `split` raises. A number stands for the margin of a calibration, which is not known yet."""
    try:
        split(method.replace("@conformal", "@0"))
    except SpecshieldError as error:
        error.got = method
        raise


class _Progress(StatusLine):
    """A bar, and how much time is left."""

    def __init__(self, title: str, runs: int) -> None:
        super().__init__()
        self.title, self._runs = title, runs
        self._began, self._there = time.monotonic(), 0

    def show(self, done: int) -> None:
        """done: runs that are finished. The first call counts those that were kept from before."""
        self._there = self._there or done
        made = done - self._there
        left = (time.monotonic() - self._began) / made * (self._runs - done) if made else None
        said = "" if left is None else f", {duration(left)} left"
        filled = WIDTH * done // self._runs
        bar = "#" * filled + "." * (WIDTH - filled)
        self.say(f"{self.title}: [{bar}] {done} of {self._runs} runs{said}")
