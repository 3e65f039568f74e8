"""What `specshield demo` and `evaluate` do. Each returns the command's exit status."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from evaluation import evaluation, results
from evaluation.calibration import calibrated
from evaluation.experiment import CERTIFYING, Experiment, split
from specshield.client import ShieldClient
from specshield.sim import picture, report
from specshield.sim.campaign import Campaign, run
from specshield.sim.cases import Case, case_names, load_case
from specshield.sim.progress import StatusLine, bar, duration
from specshield.sim.service import own_server

PATIENCE = 10.0  # [s] for one decision: other work may share the machine


def demo(runs: int, seed: int, out: Path) -> int:
    """Every case, with and without the shield: a table, and a picture of each case in `out`.

    1 if an episode with the shield broke its rule.
    """
    began, status = time.monotonic(), StatusLine()
    status.say("starting the service (its first start compiles: about a minute) ...")
    with own_server() as url, ShieldClient(url, timeout=PATIENCE) as client:
        campaigns = [_campaign(client, load_case(name), runs, seed, status) for name in case_names()]
    for campaign in campaigns:
        picture.draw(
            campaign.case, campaign.shielded[0], campaign.unshielded[0], out / f"{campaign.case.name}.png"
        )
    status.clear()
    print(f"{runs} episodes a case, seed {seed}, over HTTP\n")
    for campaign in campaigns:
        print(
            f'{campaign.case.name}  {campaign.case.task.formula}\n       model: "{campaign.case.instruction}"'
        )
    print(f"\n{report.table([report.summary(campaign) for campaign in campaigns])}\n")
    for campaign in campaigns:
        print(f"picture: {out / campaign.case.name}.png")
    print(f"{time.monotonic() - began:.0f} s")
    return _exit_status(campaigns)


def evaluate(
    experiments: Sequence[Experiment],
    runs: int,
    methods: Sequence[str],
    out: Path | None,
    processes: int,
    redis_url: str | None,
    as_json: bool,
) -> int:
    """Each experiment by each method: a table, or with `as_json` the figures and every record.

    out: the folder of the results, one folder an experiment; what is there already is not done again. 1 if a
    method that certifies its actions broke the rule in a world that was as told.
    """
    for name in methods:  # what cannot be is said before anything that takes long
        split(name.replace("@conformal", "@0"))
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
        figures = results.results(experiment, records) if folder is None else results.write(folder)
        if as_json:
            print(json.dumps({**figures, "records": [record.to_json() for record in records]}))
        else:
            print(
                f"{progress.title}, model {experiment.model}, seed {experiment.seed}: {figures['formula']}\n"
            )
            print(f"{results.table(figures)}\n")
            print(f"{duration(time.monotonic() - began)}{'' if folder is None else f'; {folder}'}")
        broken |= experiment.noise == "none" and any(
            not record.satisfied and split(record.method)[0] in CERTIFYING for record in records
        )
    return 1 if broken else 0


class _Progress(StatusLine):
    """A bar with the time left."""

    def __init__(self, title: str, runs: int) -> None:
        super().__init__()
        self.title, self._runs = title, runs
        self._began, self._there = time.monotonic(), 0

    def show(self, done: int) -> None:
        """The first call says what was there already."""
        self._there = self._there or done
        made = done - self._there
        left = (time.monotonic() - self._began) / made * (self._runs - done) if made else None
        said = "" if left is None else f", {duration(left)} left"
        self.say(f"{self.title}: [{bar(done, self._runs)}] {done} of {self._runs} runs{said}")


def _campaign(client: ShieldClient, case: Case, runs: int, seed: int, status: StatusLine) -> Campaign:
    began = time.monotonic()

    def show(done: int) -> None:
        left = (time.monotonic() - began) / done * (runs - done)
        status.say(f"{case.name}: {done} of {runs} episodes, {duration(left)} left")

    return run(client, case, runs, seed, show)


def _exit_status(campaigns: list[Campaign]) -> int:
    broken = [
        episode
        for campaign in campaigns
        for episode in campaign.shielded
        if episode.spec_status != "satisfied"
    ]
    for episode in broken:
        print(
            f"BROKEN: {episode.case} from {episode.start}, seed {episode.seed}: {episode.spec_status}",
            file=sys.stderr,
        )
    return 1 if broken else 0
