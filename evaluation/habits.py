"""Does it matter how close the answer stays to the model? Two models with habits that a shield may break.

courteous   near people it moves at every second step at most: at what share of the steps there this is broken
follower    it was told its way, and remembers its recent steps: how often it loses its way, and what it costs
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from evaluation.evaluation import evaluate
from evaluation.experiment import Experiment
from evaluation.models import courteous, follower
from evaluation.results import markdown, share
from evaluation.runs import Record
from evaluation.statistics import clopper_pearson, compared, extra_steps, mean_of
from evaluation.writeup import write_page
from specshield.sim.cases import Case

CASES = ("case1", "case2")
METHODS = ("unmodified", "rule-first", "simplex", "ours", "adaptive@0/25", "lookahead")
HEADS = ("method", "rule satisfied", "main task done", "KL a run [nats]", "extra steps")
INTRODUCTION = """# Does staying close to the model matter?

Written by `{command}`. With `learned` and `unsteered` ([results.md](results.md), 80 runs a case, seed 0)
projection has a smaller divergence from the model in both cases than following the rule first and the
model then, and is shown to need fewer steps in case 2 alone; with other models and in other apartments
that differs ([models](results/models.md), [houses](results/houses.md)). Here are two models for which
closeness could matter: one has a habit that people care for, and the other a memory that detours break.
Neither knows the rule. The robot moves as the shield was told, `uncertainty` is `"none"`, and the methods
are those of [results/cases.md](results/cases.md). All methods share starts, model seeds and draws. Shares
of runs have 95 % Clopper-Pearson intervals, the others 95 % intervals of a bootstrap over runs. Extra
steps are over the runs in which both did the main task."""
COURTEOUS = f"""## A habit: slow near people

There is a person in the middle of each room. Within {courteous.NEAR_PEOPLE:g} m of one, the model waits after
each step in which it moved. Hasty: of the steps near people, those at which the robot moved straight after
having moved. While the model has its task, and of the whole run, which ends with rule and task."""
FOLLOWER = f"""## A memory: its own way

The model is told its way at the start. Once it has been off it for more than {follower.MEMORY} steps, it is
lost for good, and looks for its target by driving to points that it sees."""


def measure(runs: int, seed: int, out: Path, page: Path, processes: int) -> None:
    """Runs what `out` does not hold yet, prints the tables and writes the page."""
    command = f"python -m evaluation habits --runs {runs} --seed {seed}"
    parts = [INTRODUCTION.format(command=command)]
    for model, about in (("courteous", COURTEOUS), ("follower", FOLLOWER)):
        parts.append(about)
        for name in CASES:
            experiment = Experiment(name, model=model, seed=seed)
            records = evaluate(experiment, runs, METHODS, out / model / name, processes)
            parts.append(f"{name}, {runs} runs:\n\n{_table(experiment.setting.case, model, records)}")
            print(f"{model}, {parts[-1]}\n", flush=True)
    write_page(page, parts)


def _table(case: Case, model: str, records: Sequence[Record]) -> str:
    by_method = {name: [record for record in records if record.method == name] for name in METHODS}
    own = ("hasty, with the task", "hasty, whole run") if model == "courteous" else ("lost its way",)
    what = _hasty if model == "courteous" else _lost
    rows = [
        [name, *_costs(those, by_method["unmodified"]), *what(case, those)]
        for name, those in by_method.items()
    ]
    return markdown((*HEADS, *own), rows)


def _costs(records: Sequence[Record], plain: Sequence[Record]) -> list[str]:
    later = mean_of(extra_steps(zip(records, plain, strict=True)))
    return [
        _of(sum(record.satisfied for record in records), len(records)),
        _of(sum(record.main_done for record in records), len(records)),
        _interval(mean_of([record.kl for record in records])),
        _interval(later),
    ]


def _with_task(record: Record) -> list[list[float]]:
    """The way while the model has its task."""
    return record.poses if record.ended_at is None else record.poses[: record.ended_at + 1]


def _hasty(case: Case, records: Sequence[Record]) -> list[str]:
    with_task = [courteous.habit(case, _with_task(record)) for record in records]
    whole = [courteous.habit(case, record.poses) for record in records]
    return [_ratio([(hasty, near) for near, hasty in each]) for each in (with_task, whole)]


def _lost(case: Case, records: Sequence[Record]) -> list[str]:
    gone = [follower.lost(case, _with_task(record)) for record in records]
    return [_of(sum(gone), len(gone))]


def _of(count: int, of: int) -> str:
    low, high = clopper_pearson(count, of)
    return share({"count": count, "of": of, "low": low, "high": high})


def _ratio(pairs: Sequence[tuple[float, float]]) -> str:
    found = compared(pairs)
    if found["share"] is None or found["low"] is None:
        return "-"
    return f"{100 * found['share']:.1f} % ({100 * found['low']:.1f} to {100 * found['high']:.1f})"


def _interval(found: dict[str, float | None]) -> str:
    if found["mean"] is None:
        return "-"
    return f"{found['mean']:.1f} ({found['low']:.1f} to {found['high']:.1f})"
