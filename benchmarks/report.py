"""docs/benchmarks.md and its plots, out of the figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

from benchmarks.decisions import NAMES

mpl.use("Agg")
from matplotlib import pyplot as plt

COLUMNS = ("p50", "p90", "p99", "p99.9", "max")
SWEPT = ("p50", "p99", "max")
SERVED = ("p50", "p90", "p99", "max")
SWEEPS = {"c": "(c)", "lost": "(c) lost", "d": "(d)"}
PLACES = {"start": "t = 0", "along": "along episodes"}
COLOURS = {"a": "tab:gray", "b": "tab:olive", "c": "tab:blue", "d": "tab:green"}
Figures = dict[str, Any]


def write(out: Path, figures: Figures, race: Figures | None) -> None:
    """benchmarks.md in the folder `out`, the plots in out/benchmarks."""
    plots = out / "benchmarks"
    _plot_decisions(plots / "decisions.png", figures)
    _plot_sweeps(plots / "growth.png", figures)
    if race:
        _plot_race(plots / "race.png", race)
    (out / "benchmarks.md").write_text("\n".join(_lines(figures, race)) + "\n")


def _lines(figures: Figures, race: Figures | None) -> Iterator[str]:
    machine, size = figures["machine"], figures["size"]
    yield "# Benchmarks"
    yield ""
    yield (
        f"Written by `{figures['command']}` in {figures['seconds']} s: {machine['cpu']}, one core of "
        f"{machine['cores']}, one thread, Python {machine['python']}, load {machine['load']:.1f} before. "
        f"A call is made {size['repeats']} times and the quickest counts, since the machine is shared. "
        f"Milliseconds, unless it says otherwise. All figures: `benchmarks/figures.json`."
    )
    yield ""
    yield "Four programs decide the same states, 20 Stretch actions:"
    yield ""
    yield (
        f"- **(a)** {NAMES['a']}: the shipped network in torch (eager), observation, dynamics and regions in "
        "NumPy, a rollout for each of the 19 actions that do not end, rtamt's offline robustness of each."
    )
    yield (
        f"- **(b)** {NAMES['b']}: the 7 distinct motions as one batch through torch and NumPy; specshield's "
        "vectorised robustness instead of rtamt."
    )
    yield f"- **(c)** {NAMES['c']}: `episode.decide`."
    yield f"- **(d)** {NAMES['d']}: `episode.decide`."
    yield ""
    yield (
        "(a) and (b) decide fewer states; their ratios to (c) and (d) are medians over the states that all "
        "four decide. Along episodes (c) and (d) have what the last decision handed on, as in a session."
    )
    yield ""
    yield "## A decision"
    for name, case in figures["decisions"].items():
        for place, words in PLACES.items():
            yield ""
            yield f"### {name}, {words}"
            yield ""
            yield from _decisions(case[place])
    yield ""
    yield "![A decision](benchmarks/decisions.png)"
    yield ""
    yield "## Where the time goes"
    yield ""
    yield "Median of the first 60 states."
    yield ""
    yield from _parts(figures)
    yield ""
    yield "## To the first decision"
    yield ""
    yield "Case 1, a new process, seconds; reachability computes its tables in it."
    yield ""
    yield from _cold(figures["cold"])
    yield ""
    yield "## Growth"
    yield ""
    yield (
        "Case 2 at t = 0, from starts feasible or not (none breaks the rule already): its windows "
        "stretched to each horizon (7 distinct "
        "motions, the shipped network), and with made robots of more distinct motions (T = 150, the shipped "
        "network, which uses the Stretch's seven of them; lost: one of random weights, which satisfies "
        "nothing, so that each motion is followed by a rollout of its own and each step of it looks at each)."
    )
    yield ""
    yield from _sweep("T", "horizon", figures["horizons"])
    yield ""
    yield from _sweep("motions", "actions", figures["actions"])
    yield ""
    yield "![Growth](benchmarks/growth.png)"
    yield ""
    yield "## Making a policy"
    yield ""
    yield "Reachability on one core, compiled; the DQN as its card says, from the training that was shipped."
    yield ""
    yield from _synthesis(figures["synthesis"])
    yield ""
    yield "## The service"
    yield ""
    yield (
        "`specshield serve` with its embedded store and worker, over HTTP, all cores: from the POST of a "
        "reachability policy until it is `ready` (each one another, made anew), and a step of one robot with "
        "the learned model, as the robot waits for it and as the server says."
    )
    yield ""
    yield from _service(figures["service"])
    if race:
        yield ""
        yield from _race(race)


def _decisions(here: Figures) -> Iterator[str]:
    rows = []
    for key in "abcd":
        row = here[key]
        ratios = [f"{here['ratios'][f'{plain}/{key}']:.0f}x" if key in "cd" else "" for plain in "ab"]
        rows.append([f"({key})", *(_ms(row[c]) for c in COLUMNS), str(row["calls"]), *ratios])
    rows += [
        [f"({key}) called once", *(_ms(row[c]) for c in COLUMNS), str(row["calls"]), "", ""]
        for key, row in here["once"].items()
    ]
    yield from _table(["", *COLUMNS, "states", "(a) / it", "(b) / it"], rows)
    found = here["agreement"]
    yield ""
    yield (
        f"J of (a) and (b) against (c) with pi_phi's own rollout after every motion: {found['pairs']} pairs "
        f"of state and action, {found['satisfied']} with J = 1; {found['differ']} differ; {found['parted']} "
        f"rollouts parted; rho elsewhere within {found['rho']:.0e} m. (c) as timed has {found['more']} more."
    )


def _parts(figures: Figures) -> Iterator[str]:
    rows, names = [], list[str]()
    for name, case in figures["decisions"].items():
        for place, words in PLACES.items():
            for key, parts in case[place]["parts"].items():
                names = list(parts)
                rows.append([f"({key}) {name}, {words}", *(f"{value:.3f}" for value in parts.values())])
    yield from _table(["", *names], rows)


def _cold(times: Figures) -> Iterator[str]:
    rows = []
    for method, caches in times.items():
        for cache, laps in caches.items():
            made = laps.get("load", laps.get("synthesis", 0.0))
            seconds = (laps["import"], made, laps["first decision"], laps["total"])
            rows.append([method, cache, *(f"{value:.2f}" for value in seconds)])
    header = ["", "compiled kernels", "import", "load or synthesis", "first decision", "total"]
    yield from _table(header, rows)


def _sweep(title: str, field: str, rows: Sequence[Figures]) -> Iterator[str]:
    keys = {key: label for key, label in SWEEPS.items() if key in rows[0]}
    header = [
        title,
        *(f"{label} {c}" for label in keys.values() for c in SWEPT),
        "(d) feasible",
        "synthesis [s]",
    ]
    yield from _table(
        header,
        [
            [str(row[field]), *(_ms(row[key][c]) for key in keys for c in SWEPT),
             f"{row['d']['feasible']:.0%}", f"{row['synthesis_s']:.2f}"]
            for row in rows
        ],
    )  # fmt: skip


def _synthesis(cases: Figures) -> Iterator[str]:
    rows = []
    for name, made in cases.items():
        dqn = made["dqn"]
        reach = [
            f"{made['synthesis_s']:.2f} s",
            f"{made['load_s']:.3f} s",
            f"{made['size_bytes'] / 1e6:.1f} MB",
            f"{made['stepwise_s']:.1f} s, {made['stepwise_bytes'] / 1e6:.0f} MB",
        ]
        rows.append(
            [name, *reach, f"{dqn['wall_time_s']:.0f} s", str(dqn["updates"]), f"{dqn['satisfied']:.1%}"]
        )
    header = ["", "reachability", "loaded in", "size", "cannot wait: tables a step"]
    header += ["DQN", "updates", "satisfies alone from"]
    yield from _table(header, rows)


def _service(cases: Figures) -> Iterator[str]:
    rows = []
    for name, case in cases.items():
        times = [*(case["round_trip"][c] for c in SERVED), *(case["server"][c] for c in SERVED)]
        ready = ", ".join(f"{seconds:.2f}" for seconds in case["ready_s"])
        rows.append([name, ready, *map(_ms, times), str(case["server"]["calls"])])
    header = ["", "ready after [s]", *(f"{c}" for c in SERVED), *(f"server {c}" for c in SERVED), "steps"]
    yield from _table(header, rows)


def _race(race: Figures) -> Iterator[str]:
    yield (
        f"`{race['command']}`: {race['case']}, the same environment and rewards, until the greedy policy "
        f"alone satisfies from {race['rate']:.0%} of 1,000 starts, {race['minutes']:g} minutes at most. "
        "stable-baselines3 has its defaults, with our network's size, discount and learning rate, and one "
        "robot; ours steps 512 robots at once."
    )
    yield ""
    rows = []
    for name in ("specshield DQN", "stable-baselines3 DQN"):
        curve = race[name]
        won = curve and curve[-1][1] >= race["rate"]
        best = max((rate for _, rate in curve), default=0.0)
        last = curve[-1][0] if curve else 0.0
        rows.append([name, f"{last:.0f} s" if won else f"not in {last:.0f} s", f"{best:.1%}"])
    yield from _table(["", f"to {race['rate']:.0%}", "best rate measured"], rows)
    yield ""
    yield "![Race](benchmarks/race.png)"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield "| " + " | ".join(header) + " |"
    yield "|" + "|".join(["---"] + ["--:"] * (len(header) - 1)) + "|"
    for row in rows:
        yield "| " + " | ".join(row) + " |"


def _ms(value: float) -> str:
    return f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"


def _plot_decisions(path: Path, figures: Figures) -> None:
    panels = [(name, place) for name in figures["decisions"] for place in PLACES]
    figure, axes = plt.subplots(1, len(panels), figsize=(3.2 * len(panels), 3.4), sharey=True, squeeze=False)
    for axis, (name, place) in zip(axes[0], panels, strict=True):
        for key, colour in COLOURS.items():
            row = figures["decisions"][name][place][key]
            axis.plot(COLUMNS, [row[c] for c in COLUMNS], "o-", color=colour, label=f"({key}) {NAMES[key]}")
        axis.set(yscale="log", title=f"{name}, {PLACES[place]}")
        axis.grid(alpha=0.3, which="both")
    axes[0][0].set_ylabel("a decision [ms]")
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper center", ncol=2, bbox_to_anchor=(0.5, 0.02))
    _save(figure, path, figures["command"])


def _plot_sweeps(path: Path, figures: Figures) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
    panels = (("horizon", "horizons", "horizon T"), ("actions", "actions", "distinct motions"))
    for axis, (field, section, label) in zip(axes, panels, strict=True):
        rows = figures[section]
        for key in "cd":
            for column, style in (("p50", "o-"), ("p99", "o--")):
                axis.plot(
                    [row[field] for row in rows], [row[key][column] for row in rows], style,
                    color=COLOURS[key], label=f"({key}) {column}",
                )  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel=label, ylabel="a decision [ms]")
        axis.set_xticks([row[field] for row in rows], [str(row[field]) for row in rows])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0].legend()
    _save(figure, path, figures["command"])


def _plot_race(path: Path, race: Figures) -> None:
    figure, axis = plt.subplots(figsize=(6, 3.6))
    for name, colour in (("specshield DQN", "tab:blue"), ("stable-baselines3 DQN", "tab:red")):
        axis.plot([s for s, _ in race[name]], [rate for _, rate in race[name]], color=colour, label=name)
    axis.axhline(race["rate"], color="black", linewidth=0.6, linestyle=":")
    axis.set(xlabel="seconds of training", ylabel="satisfied from", ylim=(0.0, 1.0))
    axis.legend()
    _save(figure, path, race["command"])


def _save(figure: Any, path: Path, command: str) -> None:
    figure.suptitle(command, fontsize=8)
    figure.tight_layout(rect=(0.0, 0.06, 1.0, 1.0))
    figure.savefig(path, dpi=120, bbox_inches="tight", metadata={"Software": None})
    plt.close(figure)
