"""Pictures of an experiment: ways over the map; robustness, feasible mass and modes with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, product
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evaluation.experiment import METHODS, split
from evaluation.runs import Record
from evaluation.statistics import MODES
from specshield.drawing.colors import AVOID, BLUE, FAINT, GREY, INK, ORANGE, PAPER, TARGET, VISIT
from specshield.sim.canvas import Canvas
from specshield.sim.cases import Case
from specshield.stl import robustness

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

WAYS = 6  # runs drawn on a map
SCALE, TITLE = 40, 18  # of a panel: pixels a metre, and pixels above the map
COLUMNS = 4  # panels side by side
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
    written = [folder / "ways.png"]
    _ways(case, by_method).quantize(64).save(written[0])  # few colours, a third of the bytes
    with plt.rc_context(STYLE):
        for name, make in (("robustness", _robustness), ("mass", _mass), ("modes", _modes)):
            figure = make(case, by_method)
            written.append(folder / f"{name}.png")
            figure.savefig(written[-1], bbox_inches="tight")
            plt.close(figure)
    return written


def _ways(case: Case, by_method: ByMethod) -> Image.Image:
    """The first WAYS runs over the map, one panel a method."""
    panels = [_panel(case, name, records[:WAYS]) for name, records in by_method.items()]
    wide, tall = panels[0].size
    columns = min(len(panels), COLUMNS)
    picture = Image.new("RGB", (wide * columns, tall * -(-len(panels) // columns)), PAPER)
    for i, panel in enumerate(panels):
        picture.paste(panel, (wide * (i % columns), tall * (i // columns)))
    return picture


def _panel(case: Case, name: str, records: Sequence[Record]) -> Image.Image:
    """The runs of one method: blue where the rule is kept, orange where it is not, grey after its horizon."""
    canvas = Canvas(case.task, SCALE, above=TITLE)
    canvas.walls()
    canvas.regions(10)
    for record in records:
        canvas.way(record.poses, BLUE if record.satisfied else ORANGE, 1.2)
        canvas.dot(record.poses[0], 2.5, INK, INK)
    canvas.dot(case.target, 4.0, TARGET, INK)
    kept = sum(record.satisfied for record in records)
    said = f"{name}: {kept} of {len(records)} kept"
    canvas.text(canvas.top, said, 13, shift=(0, -TITLE / 2), anchor="lm")
    return canvas.picture()


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
