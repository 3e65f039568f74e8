"""Pictures of an experiment, with matplotlib: ways over the map, robustness and feasible mass, modes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, product
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from evaluation.experiment import METHODS, split
from evaluation.runs import Record
from evaluation.statistics import MODES
from specshield.sim.cases import Case
from specshield.sim.picture import avoided
from specshield.stl import robustness
from specshield.world.regions import signed_distance

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.patheffects import Normal, Stroke

WAYS = 6  # runs drawn on a map
INK, FAINT, WALL, PAPER = "#282b32", "#9ea0a5", "#343840", "#faf9f6"
AFTER = "#b4b4b4"  # a way where the rule asks nothing any more
GOOD, BAD, TARGET = "#2b8a5a", "#c63c3c", "#f6be28"
COLORS = ("#8a8d94", "#e27d22", "#b0479a", "#5f9ea0", "#7a5cc8", "#2563c8", "#2b8a5a", "#c63c3c")
LOOKS = tuple(product(("-", "--", ":"), COLORS))  # of methods, in their order
OF_MODE = {
    "shaped": "#2563c8", "switched": "#e27d22", "completion": "#2b8a5a", "prior": "#c9ccd3",
    "fallback": "#f6be28", "violated": "#c63c3c",
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
    written = []
    with plt.rc_context(STYLE):
        for name, make in (("ways", _ways), ("robustness", _robustness), ("mass", _mass), ("modes", _modes)):
            figure = make(case, by_method)
            written.append(folder / f"{name}.png")
            figure.savefig(written[-1], bbox_inches="tight")
            plt.close(figure)
    return written


def _ways(case: Case, by_method: ByMethod) -> Any:
    """The first WAYS runs over the map, one panel a method; grey where the rule asks nothing any more."""
    asked = case.task.horizon + 1
    columns = min(len(by_method), 4)
    rows = -(-len(by_method) // columns)
    xmin, ymin, xmax, ymax = case.task.grid.bounds
    tall = 3.1 * (ymax - ymin) / (xmax - xmin) + 0.35
    figure, axes = plt.subplots(rows, columns, figsize=(3.1 * columns, tall * rows), squeeze=False)
    for axis in axes.flat[len(by_method) :]:
        axis.axis("off")
    for axis, (name, records) in zip(axes.flat, by_method.items(), strict=False):
        _floor(axis, case)
        drawn = records[:WAYS]
        for record in drawn:
            x, y, _ = np.array(record.poses).T
            color = "#2563c8" if record.satisfied else "#e27d22"
            axis.plot(x[asked - 1 :], y[asked - 1 :], color=AFTER, lw=0.8)
            axis.plot(x[:asked], y[:asked], color=color, lw=1.0, alpha=0.8)
            axis.plot(x[0], y[0], "o", color=INK, ms=2.6)
        axis.plot(*case.target, "*", color=TARGET, mec=INK, mew=0.6, ms=10)
        kept = sum(record.satisfied for record in drawn)
        axis.set_title(f"{name}: {kept} of {len(drawn)} kept")
    figure.supxlabel("blue: the rule is kept, orange: it is not, grey: after its horizon", fontsize=9)
    figure.tight_layout()
    return figure


def _floor(axis: Axes, case: Case) -> None:
    grid = case.task.grid
    xmin, ymin, xmax, ymax = grid.bounds
    x, y = np.linspace(xmin, xmax, 400), np.linspace(ymin, ymax, 400)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    cells = np.floor(grid.to_grid(points) / grid.resolution).astype(int)
    i, j = cells[..., 1].clip(0, grid.height - 1), cells[..., 0].clip(0, grid.width - 1)
    axis.imshow(
        grid.occupied[i, j], cmap=ListedColormap([PAPER, WALL]), origin="lower",
        extent=(xmin, xmax, ymin, ymax), interpolation="nearest",
    )  # fmt: skip
    bad = avoided(case.task.formula)
    for name, region in case.task.regions.items():
        color, depth = BAD if name in bad else GOOD, signed_distance(region, points)
        axis.contourf(x, y, depth, levels=[0.0, np.inf], colors=[color], alpha=0.15)
        axis.contour(x, y, depth, levels=[0.0], colors=[color], linewidths=1.0)
        rows, columns = np.nonzero(depth > 0.0)
        below = points[rows.min(), int(columns[rows == rows.min()].mean())] - (0.0, 0.08)
        halo = [Stroke(linewidth=2.0, foreground=PAPER), Normal()]  # readable across a wall
        axis.annotate(name, below, color=color, fontsize=6.5, ha="center", va="top", path_effects=halo)
    axis.set_axis_off()


def _robustness(case: Case, by_method: ByMethod) -> Any:
    """rho if the robot stood still from each step on: median over the runs, and the middle 80 %."""
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
    """pi_FM(S_t) of the methods that know it."""
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
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _band(axis: Axes, values: Floats, name: str, look: tuple[str, str]) -> None:
    """values [runs, steps]; steps that nobody has a value at are left out. look: of LOOKS."""
    line, color = look
    there = np.isfinite(values).any(axis=0)
    low, middle, high = np.nanpercentile(values[:, there], (10, 50, 90), axis=0)
    steps = np.flatnonzero(there)
    axis.fill_between(steps, low, high, color=color, alpha=0.08, lw=0)
    axis.plot(steps, middle, line, color=color, lw=1.6, label=name)


def _modes(case: Case, by_method: ByMethod) -> Any:
    """Of all decisions of a method, the share made in each mode."""
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
