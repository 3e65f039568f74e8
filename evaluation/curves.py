"""Curves: how often the rule is kept with thresholds below 1 or with a real-valued J, and at what cost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from matplotlib import pyplot as plt

from evaluation.colors import BLUE, INK, ORANGE, VISIT
from evaluation.evaluation import evaluate
from evaluation.experiment import Experiment
from evaluation.figures import STYLE
from evaluation.results import markdown, share
from evaluation.statistics import summary

COLORS = {"step": ORANGE, "episode": BLUE, "robustness": VISIT}
COLUMNS = (("step", "episode"), ("robustness",))  # kinds whose thresholds share an axis
LINES = ("-", "--", ":", "-.")  # of the models, in their order
INTRODUCTION = """\
# Thresholds below 1, and real-valued J

Written by `python -m evaluation curves`. Every row is of {runs} runs of `ours`, reachability and the DQN
together, seed {seed}; the rows of a case and a model share starts, model seeds and draws. The robot moves
as the shield was told, and `uncertainty` is `"none"`. The starts are those from which
the DQN alone finds a way to keep the rule, and both together do. `unmodified` is the model alone, which
stands still after its `end`. With a threshold, the robot completes the rule after the model's `end`, as
Algorithm 1 says. A threshold of 0 would be `unmodified` with that completion.

- **step**: E[J] >= threshold at each step, J binary, as the paper has it (`threshold`).
- **episode**: the same over the whole episode (`threshold_over: "episode"`).
- **robustness**: E[rho] >= threshold [m] at each step, J = rho (`evaluation: "robustness"`).

Only the threshold 1 with binary J, which is `ours` as in other pages, carries the guarantee. Shares have
95 % Clopper-Pearson intervals, the mean KL that of a bootstrap over runs. "After it was lost" is the mean
number of decisions a run in mode `violated`: a session whose rule is broken goes on to enforce what can
still be kept of it, and KL counts that too."""
Row = dict[str, Any]  # case, model, kind ("unmodified" or of COLORS), threshold, and `summary` of the runs


def draw_all(
    experiments: Sequence[Experiment],
    thresholds: Sequence[float],
    metres: Sequence[float],
    runs: int,
    out: Path,
    page: Path,
    processes: int,
) -> None:
    """Makes the runs that `out` has not got yet; writes the page and its figure after each experiment."""
    methods, rows = methods_of(thresholds, metres), list[Row]()
    figure = page.with_suffix("") / "curves.png"
    figure.parent.mkdir(parents=True, exist_ok=True)
    for experiment in experiments:
        folder = out / experiment.model / experiment.case / experiment.noise
        records = evaluate(experiment, runs, list(methods.values()), folder, processes)
        for (kind, threshold), method in methods.items():
            made = summary(method, [record for record in records if record.method == method], [])
            about = {"case": experiment.case, "model": experiment.model, "kind": kind, "threshold": threshold}
            rows.append({**about, **made})
        draw(rows, figure)
        command = _command(experiments, thresholds, metres, runs, out)
        page.write_text(text(rows, runs, experiment.seed, figure.relative_to(page.parent), command))


def methods_of(thresholds: Sequence[float], metres: Sequence[float]) -> dict[tuple[str, float], str]:
    """The method of each kind and threshold. Threshold 1 is `ours`, over step and episode alike."""
    found = {("unmodified", 0.0): "unmodified"}
    for kind in COLUMNS[0]:
        found |= {(kind, d): "ours" if d == 1.0 else f"ours@{kind}/{d:g}" for d in sorted(thresholds)}
    return found | {("robustness", d): f"ours@robustness/{d:g}" for d in sorted(metres)}


def text(rows: Sequence[Row], runs: int, seed: int, figure: Path, command: str) -> str:
    """The page."""
    heads = (
        "case, model", "kind", "threshold", "rule kept", "KL a run [nats]", "main task done",
        "after it was lost",
    )  # fmt: skip
    table = [
        (
            f"{row['case']}, {row['model']}",
            row["kind"],
            "-" if row["kind"] == "unmodified" else f"{row['threshold']:g}",
            share(row["satisfied"]),
            "{:.1f} ({:.1f} to {:.1f})".format(row["kl"], *row["kl_interval"]),
            share(row["main_done"]),
            f"{row['modes'].get('violated', 0) / row['runs']:.0f}",
        )
        for row in rows
    ]
    parts = [
        INTRODUCTION.format(runs=runs, seed=seed),
        f"![rule kept, KL and main task by threshold]({figure})",
        "\n".join(_told(rows)),
        markdown(heads, table),
        f"```sh\n{command}\n```",
    ]
    return "\n\n".join(parts) + "\n"


def _told(rows: Sequence[Row]) -> Iterator[str]:
    """A sentence for each kind of threshold."""
    whole = {(row["case"], row["model"]): row["kl"] for row in rows if row["method"] == "ours"}
    for kind in COLUMNS[0]:
        asked = [row for row in rows if row["kind"] == kind and row["threshold"] < 1.0]
        if not asked:
            continue
        below = sum(row["satisfied"]["high"] < row["threshold"] for row in asked)
        above = sum(row["satisfied"]["low"] > row["threshold"] for row in asked)
        costs = [row["kl"] / whole[row["case"], row["model"]] for row in asked if whole]
        yield (
            f"- **{kind}**: of {len(asked)} row{'s'[: len(asked) != 1]} with a threshold below 1, the "
            f"interval of the share kept lies below\n  the threshold in {below} and above it in {above}."
            + (f" Their KL is {min(costs):.2f} to {max(costs):.2f} of that at 1." if costs else "")
        )
    values = [row for row in rows if row["kind"] == "robustness" and row["threshold"] >= 0.0]
    if values:
        yield (
            "- **robustness**: " + "; ".join(_kept(values)) + ". A mean above 0 leaves mass on\n"
            "  actions whose rho is below 0."
        )


def _kept(rows: Sequence[Row]) -> Iterator[str]:
    """At each threshold in metres, in how many runs of a row the rule is kept."""
    for metres in sorted({row["threshold"] for row in rows}):
        kept = [row["satisfied"] for row in rows if row["threshold"] == metres]
        counts = sorted(each["count"] for each in kept)
        told = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
        yield f"at {metres:g} m the rule is kept in {told} of {kept[0]['of']} runs a row"


def draw(rows: Sequence[Row], file: Path) -> None:
    """A row of panels for each measure; two columns for each case, since rho has thresholds in metres."""
    cases, models = (list(dict.fromkeys(row[name] for row in rows)) for name in ("case", "model"))
    columns = list(product(cases, COLUMNS))
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            3, len(columns), figsize=(2.7 * len(columns), 6.4), sharex="col", sharey="row", squeeze=False
        )
        for column, (case, kinds) in enumerate(columns):
            for kind, model in product(kinds, models):
                of = [row for row in rows if (row["case"], row["model"], row["kind"]) == (case, model, kind)]
                if not of:  # the experiment is still to come
                    continue
                look = {"color": COLORS[kind], "ls": LINES[models.index(model) % len(LINES)]}
                _lines(list(axes[:, column]), of, look, f"{kind}, {model}")
            axes[0, column].set_title(case)
            axes[-1, column].set_xlabel("threshold" if "step" in kinds else "threshold, J = rho [m]")
            if "step" in kinds:
                axes[0, column].plot([0, 1], [0, 1], color=INK, lw=0.6)  # kept as often as asked
        for axis, measure in zip(axes[:, 0], ("rule kept", "KL a run [nats]", "main task done"), strict=True):
            axis.set_ylabel(measure)
        drawn = [line for axis in axes[0, :2] for line in axis.get_lines() if line.get_label()[0] != "_"]
        figure.legend(drawn, [line.get_label() for line in drawn], loc="upper center", ncols=3,
                      bbox_to_anchor=(0.5, 0.03))  # fmt: skip
        figure.savefig(file, bbox_inches="tight")
        plt.close(figure)


def _lines(axes: Sequence[Any], rows: Sequence[Row], look: dict[str, str], name: str) -> None:
    at = [row["threshold"] for row in rows]
    shares = [
        [(one["count"] / one["of"], one["low"], one["high"]) for one in (row[measure] for row in rows)]
        for measure in ("satisfied", "main_done")
    ]
    for axis, values in zip(
        axes, (shares[0], [(row["kl"], *row["kl_interval"]) for row in rows], shares[1]), strict=True
    ):
        middle, low, high = zip(*values, strict=True)
        axis.plot(at, middle, marker="o", ms=3, lw=1.5, label=name, **look)
        axis.fill_between(at, low, high, color=look["color"], alpha=0.12, lw=0)


def _command(
    experiments: Sequence[Experiment],
    thresholds: Sequence[float],
    metres: Sequence[float],
    runs: int,
    out: Path,
) -> str:
    cases, models = (",".join(dict.fromkeys(getattr(e, n) for e in experiments)) for n in ("case", "model"))
    asked, values = (",".join(f"{value:g}" for value in each) for each in (thresholds, metres))
    return (
        f"python -m evaluation curves --case {cases} --model {models} --thresholds {asked} --metres {values} "
        f"--runs {runs} --seed {experiments[0].seed} --out out/{out.name}"
    )
