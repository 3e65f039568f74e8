"""An experiment's results in its folder: results.json and a table in Markdown."""

from __future__ import annotations

import json
import re
from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any

from evaluation.evaluation import read, read_about
from evaluation.experiment import METHODS, SLACKS, Experiment, split
from evaluation.runs import Record
from evaluation.statistics import beside, summary


def results(experiment: Experiment, records: Sequence[Record]) -> dict[str, Any]:
    """The figures of every method in `records`, as JSON.

    refused_starts: starts that were drawn and could not be used. left: how many steps a run has after the
    rule's horizon, and in how many of its runs the unmodified model does its task within so many steps.
    beside_ours: each other method beside `ours`, run by run: beside ours@M/K where it has that margin too and
    ours was run with it. `other` names it; there is nothing where it was not run.
    """
    by_method: dict[str, list[Record]] = {}
    for record in sorted(records, key=lambda r: r.run):
        by_method.setdefault(record.method, []).append(record)
    runs = sorted({record.run for record in records})
    ranked = sorted(by_method, key=lambda name: METHODS.index(split(name)[0]))
    plain = by_method.get("unmodified", [])
    case = experiment.setting.case
    left = experiment.main.limit - case.task.horizon
    in_time = [r.main_done and r.ended_at is not None and r.ended_at < left for r in plain]
    return {
        "experiment": experiment.to_json(),
        "case": case.name,
        "formula": str(case.task.formula),
        "instruction": case.instruction,
        "runs": len(runs),
        "refused_starts": sum({record.run: record.refused for record in records}.values()),
        "left": {"steps": left, "done": sum(in_time), "of": len(plain)},
        "methods": [summary(name, by_method[name], plain) for name in ranked],
        "beside_ours": {
            name: {"other": other, **beside(by_method[name], by_method[other], plain)}
            for name in ranked
            if (other := _ours(name, by_method)) is not None
        },
    }


def _ours(name: str, there: Container[str]) -> str | None:
    """What of `there` a method is compared with."""
    alike = "ours" if split(name)[0] in SLACKS else re.sub("^[^@]+", "ours", name)
    return next((other for other in (alike, "ours") if other in there and other != name), None)


def write(folder: Path) -> dict[str, Any]:
    """Writes results.json and table.md beside the records of an experiment."""
    experiment, _ = read_about(folder)
    figures = results(experiment, read(folder))
    (folder / "results.json").write_text(json.dumps(figures, indent=1) + "\n")
    (folder / "table.md").write_text(table(figures) + "\n")
    return figures


def table(figures: dict[str, Any]) -> str:
    """One row a method. Shares with their 95 % Clopper-Pearson intervals."""
    heads = (
        "method", "rule satisfied", "main task done", "KL a run [nats]", "extra steps, mean and median",
        "fallback decisions", "feasible mass", "decision p50 / p99 [ms]",
    )  # fmt: skip
    rows = [
        (
            one["method"],
            share(one["satisfied"]),
            share(one["main_done"]),
            "{:.1f} ({:.1f} to {:.1f})".format(one["kl"], *one["kl_interval"]),
            _extra(one["extra_steps"]),
            f"{one['modes'].get('fallback', 0)} of {sum(one['modes'].values())}",
            _number(one["feasible_mass"], ".2f"),
            f"{one['decision_ms']['p50']:.2f} / {one['decision_ms']['p99']:.2f}",
        )
        for one in figures["methods"]
    ]
    return markdown(heads, rows)


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; all columns but the first are aligned to the right."""
    rule = ["---", *["--:"] * (len(heads) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in [heads, rule, *rows])


def share(of: dict[str, Any]) -> str:
    """A share as a count and its interval in per cent."""
    return f"{of['count']} of {of['of']} ({100 * of['low']:.1f} to {100 * of['high']:.1f} %)"


def _extra(steps: dict[str, Any]) -> str:
    if steps["mean"] is None:
        return "-"
    mean = "{mean:+.1f} ({low:+.1f} to {high:+.1f})".format(**steps)
    return f"{mean}, {steps['median']:+.0f}, n {steps['both']}"


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
