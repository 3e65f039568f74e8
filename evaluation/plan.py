"""The experiments of `make results`, the most important first: it may be stopped and continued."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from evaluation import campaigns
from evaluation.experiment import METHODS, SLACKS, Experiment
from evaluation.pages.words import MAIN_MODELS
from evaluation.writeup import write_up
from specshield.errors import SpecshieldError
from specshield.sim.progress import duration

CASES = ("case1", "case2")
SLACK = "ours@0/25"  # the slack that did best with a client's model; chosen by hand
PROPORTIONAL, ADAPTIVE = "proportional@0/40", "adaptive@0/25"  # of about as many steps; chosen by hand
MAIN = (*(name for name in METHODS if name not in SLACKS), SLACK, ADAPTIVE)
FEW = ("unmodified", "rule-first", "ours", SLACK, "lookahead")
RIVALS = (*FEW, PROPORTIONAL, ADAPTIVE)
NOISY = (
    "unmodified", "rule-first", "paper", "ours", "rule-first@conformal/8", "paper@conformal/8",
    "ours@conformal/8", "paper@default", "ours@default",
)  # fmt: skip
WRONG = ("slip", "obstacle", "shift", "collider")
OTHERS = ("bot", "rover", "goal-seeker", "jumper", "decoyed", "drifter")
UNTRIED = 1  # seed of the models that nothing was chosen on
DRAWN = 6  # apartments, drawn with the seeds 0 to DRAWN - 1
HARDER = ("case1-two", "case2-two", "case1-200", "case2-200")
LARGE = ("large_0", "large_1")
LEAST = 4  # runs of a campaign that is cut short


@dataclass(frozen=True)
class Campaign:
    """kind: the page that it is for, of writeup.TITLES."""

    kind: str
    experiment: Experiment
    runs: int
    methods: tuple[str, ...]


def plan(houses: Sequence[str] = ()) -> Iterator[Campaign]:
    """Every campaign, in the order in which they are run. houses: the paths of ProcTHOR houses.

    As many runs as two cores make within 90 minutes, with the other commands of `make results`.
    """
    for model in MAIN_MODELS:
        for case in CASES:
            yield Campaign("cases", Experiment(case, model=model), 80, MAIN)
    for case in CASES:
        yield Campaign("noise", Experiment(case, noise="gaussian"), 32, NOISY)
    yield Campaign("bodies", Experiment("case2b"), 24, FEW)
    for model in OTHERS:
        for case in CASES:
            yield Campaign("models", Experiment(case, model=model, seed=UNTRIED), 16, RIVALS)
    for model in MAIN_MODELS:
        for task in HARDER:
            yield Campaign("tasks", Experiment(task, model=model), 10, (*FEW, "paper"))
    for house in [*houses, *(f"drawn_{seed}" for seed in range(DRAWN))]:
        yield Campaign("houses", Experiment("house", house), 10, FEW)
    for house in LARGE:
        for model in MAIN_MODELS:
            yield Campaign("houses", Experiment("house", house, model=model), 10, FEW)
    for noise in WRONG:
        for case in CASES:
            yield Campaign("noise", Experiment(case, noise=noise), 16, ("paper", "ours", "ours@default"))


def carry_out(
    out: Path, page: Path, houses: Sequence[str], only: Collection[str], share: float, processes: int
) -> int:
    """Runs what `out` does not hold yet, and writes the pages; how many campaigns failed.

    only: kinds of campaigns; all, if it is empty. share: of each campaign's runs, for a first look. Of a
    campaign that fails it is said why; the others are run.
    """
    began, failed = time.monotonic(), 0
    asked = [each for each in plan(houses) if not only or each.kind in only]
    for i, each in enumerate(asked, 1):
        runs = each.runs if share == 1.0 else max(LEAST, math.ceil(share * each.runs))
        folder = out / each.experiment.model
        try:
            campaigns.evaluate([each.experiment], runs, each.methods, folder, processes, None, False)
        except SpecshieldError as error:
            failed += 1
            print(f"{each.kind} {each.experiment}: {error}", file=sys.stderr)
        print(f"\n[{i} of {len(asked)} campaigns, {duration(time.monotonic() - began)}]\n", flush=True)
    write_up(out, page)
    return failed
