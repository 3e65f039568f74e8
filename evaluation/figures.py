"""Pictures of an experiment: ways over the map; robustness, feasible mass and modes with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, product
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from evaluation.colors import AVOID, BLUE, FAINT, GREY, INK, ORANGE, TARGET, TINT, VISIT, WALL
from evaluation.experiment import METHODS, split
from evaluation.runs import Record
from evaluation.statistics import MODES
from specshield.drawing.outline import outlines
from specshield.drawing.rules import is_avoided
from specshield.sim.cases import Case
from specshield.stl import robustness

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

WAYS = 6  # runs drawn on a map
WIDE, COLUMNS = 3.0, 4  # of a panel [inches], and panels side by side
COLORS = ("#8a8d94", ORANGE, "#b0479a", "#5f9ea0", "#7a5cc8", BLUE, VISIT, AVOID)
LOOKS = tuple(product(("-", "--", ":"), COLORS))  # of methods, in their order
OF_MODE = {
    "shaped": BLUE, "switched": ORANGE, "completion": VISIT, "prior": GREY, "fallback": TARGET,
    "violated": AVOID,
}  # fmt: skip
STYLE: Any = {
    "font.size": 9.0, "axes.edgecolor": FAINT, "axes.labelcolor": INK, "text.color": INK, "xtick.color": INK,
    "ytick.color": INK, "axes.spines.top": False, "axes.spines.right": False, "axes.titlesize": 10.0,
    "axes.titleweight": "bold", "axes.titlelocation": "left", "legend.frameon": False,
    "figure.facecolor": "white", "savefig.dpi": 130,
}  # fmt: skip
Floats = NDArray[np.float64]
ByMethod = dict[str, list[Record]]


def draw(case: Case, records: Sequence[Record], folder: Path) -> list[Path]:
    """Writes the four pictures of an experiment; the files."""
    by_method: ByMethod = {}
    for record in sorted(records, key=lambda r: (METHODS.index(split(r.method)[0]), r.run)):
        by_method.setdefault(record.method, []).append(record)
    folder.mkdir(parents=True, exist_ok=True)
    written = list[Path]()
    pictures = (("ways", _ways), ("robustness", _robustness), ("mass", _mass), ("modes", _modes))
    with plt.rc_context(STYLE):
        for name, make in pictures:
            figure = make(case, by_method)
            written.append(folder / f"{name}.png")
            figure.savefig(written[-1], bbox_inches="tight")
            plt.close(figure)
    return written


def _ways(case: Case, by_method: ByMethod) -> Any:
    """The first WAYS runs over the map, one panel a method."""
    columns = min(len(by_method), COLUMNS)
    rows = -(-len(by_method) // columns)
    xmin, ymin, xmax, ymax = case.task.grid.bounds
    high = WIDE * (ymax - ymin) / (xmax - xmin) + 0.3  # with the title
    figure, axes = plt.subplots(
        rows, columns, figsize=(WIDE * columns, high * rows), squeeze=False, layout="tight"
    )
    for axis in axes.flat:
        axis.axis("off")
    for axis, (name, records) in zip(axes.flat, by_method.items(), strict=False):
        _panel(axis, case, name, records[:WAYS])
    return figure


def _panel(axis: Axes, case: Case, name: str, records: Sequence[Record]) -> None:
    """The runs of one method: blue where the rule is kept, orange where it is not, grey after its horizon."""
    grid, asked = case.task.grid, case.task.horizon + 1  # states that the rule is about
    x, y = np.moveaxis(grid.centres, -1, 0)
    axis.pcolormesh(x, y, np.where(grid.occupied, 1.0, np.nan), cmap=ListedColormap([WALL]), rasterized=True)
    for region, place in case.task.regions.items():
        color = AVOID if is_avoided(case.task.formula, region) else VISIT
        for line in outlines(place):
            axis.fill(*line.T, facecolor=(color, TINT), edgecolor=color, lw=1.0)
        middle, low = np.mean(outlines(place)[0][:, 0]), outlines(place)[0][:, 1].min()
        axis.annotate(region, (middle, low), (0, -2), textcoords="offset points", color=color, size=7,
                      ha="center", va="top")  # fmt: skip
    for record in records:
        way = np.array(record.poses)[:, :2]
        axis.plot(*way[asked - 1 :].T, color=GREY, lw=0.9)
        axis.plot(*way[:asked].T, color=BLUE if record.satisfied else ORANGE, lw=0.9)
        axis.plot(*way[0], "o", color=INK, ms=2.5)
    axis.plot(*case.target, "o", color=TARGET, mec=INK, ms=5.0)
    axis.set_aspect("equal")
    axis.set_title(f"{name}: {sum(record.satisfied for record in records)} of {len(records)} kept")


def _robustness(case: Case, by_method: ByMethod) -> Any:
    """rho if the robot stood still from each step on: the median over the runs, and the middle 80 %."""
    figure, axis = plt.subplots(figsize=(7.2, 3.2))
    for (name, records), look in zip(by_method.items(), cycle(LOOKS), strict=False):
        _band(axis, np.array([_if_it_stayed(case, record) for record in records]), name, look)
    axis.axhline(0.0, color=INK, lw=0.8)
    axis.set(xlabel="step", ylabel="robustness [m]", title="Robustness, standing still from this step on")
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _if_it_stayed(case: Case, record: Record) -> Floats:
    """rho of x_0 .. x_t and then x_t to the horizon, for every t. Shape [T + 1]."""
    steps = np.arange(case.task.horizon + 1)
    poses = np.array(record.poses)[np.minimum(steps, len(record.poses) - 1)]
    samples = case.task.samples(poses[np.minimum(steps[:, None], steps)])
    return robustness(case.task.formula, samples)


def _mass(case: Case, by_method: ByMethod) -> Any:
    """The feasible mass pi_FM(S_t), of the methods that compute it."""
    figure, axis = plt.subplots(figsize=(7.2, 3.0))
    length = case.task.horizon
    for (name, records), look in zip(by_method.items(), cycle(LOOKS), strict=False):
        values = np.full((len(records), length), np.nan)
        for row, record in zip(values, records, strict=True):
            mass = [np.nan if value is None else value for value in record.mass[:length]]
            row[: len(mass)] = mass
        if np.isfinite(values).any():
            _band(axis, values, name, look)
    axis.set(xlabel="step", ylabel="feasible mass", ylim=(-0.02, 1.02), title="The model's mass on S_t")
    if axis.lines:
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _band(axis: Axes, values: Floats, name: str, look: tuple[str, str]) -> None:
    """The median of values [runs, steps], and the middle 80 %, at steps with a value. look: one of LOOKS."""
    line, color = look
    there = np.isfinite(values).any(axis=0)
    low, middle, high = np.nanpercentile(values[:, there], (10, 50, 90), axis=0)
    steps = np.flatnonzero(there)
    axis.fill_between(steps, low, high, color=color, alpha=0.08, lw=0)
    axis.plot(steps, middle, line, color=color, lw=1.6, label=name)


def _modes(case: Case, by_method: ByMethod) -> Any:
    """The share of each mode in all decisions of a method."""
    figure, axis = plt.subplots(figsize=(7.2, 0.38 * len(by_method) + 0.9))
    names = list(by_method)
    counts = np.array([[sum(r.modes.get(m, 0) for r in by_method[n]) for m in MODES] for n in names], float)
    shares = counts / counts.sum(axis=1, keepdims=True)
    left = np.zeros(len(names))
    for mode, share in zip(MODES, shares.T, strict=True):
        axis.barh(names, share, left=left, color=OF_MODE[mode], label=mode, height=0.68)
        left += share
    axis.invert_yaxis()
    axis.set(xlim=(0.0, 1.0), xlabel="share of decisions", title="Decisions by mode")
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
