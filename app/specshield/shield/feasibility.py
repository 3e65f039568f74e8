"""J: does a candidate action have a future that satisfies the formula? (paper, Def. 2 and eq. 6)

Policies propose continuations; each is joined to the executed prefix and judged by its robustness: always the
joint trajectory, since one future has to satisfy every conjunct. A continuation that certifies an action is
its witness.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specshield.policy.dqn.policy import Proposer
from specshield.robot.dynamics import Body, simulate
from specshield.rule.progress import signal_rows
from specshield.rule.view import View, best_rows, look, rate
from specshield.stl import Formula, robustness, robustness_bounds
from specshield.task import Task

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Signals = Mapping[str, Floats]


@dataclass(frozen=True)
class Prefix:
    """What was driven, and what it says of a formula: rho lies in [low, high] however it goes on.

    poses [t + 1, 3], t = len(poses) - 1; signals {name: [..t + 1]}; rows [t + 1, S]: the same as an array.
    """

    task: Task
    formula: Formula
    poses: Floats
    signals: Signals
    rows: Floats
    view: View
    known: Floats  # the formula's leaves at the steps to t
    low: float
    high: float

    @property
    def t(self) -> int:
        return len(self.poses) - 1


def prefix_of(task: Task, formula: Formula, view: View, poses: Floats, signals: Signals) -> Prefix:
    """The prefix as `formula` sees it, the task's own or a part of it; view: that of the formula.

    Raises SampleError where the formula's arithmetic is not finite on it.
    """
    rows = signal_rows(task, signals, len(poses))
    known = np.empty(view.tree.size)
    low, high = look(view, poses, rows, known)
    if low != low:
        samples = task.samples(poses, signals)
        robustness_bounds(formula, {name: samples[name] for name in formula.names})  # says what and where
    return Prefix(task, formula, poses, signals, rows, view, known, low, high)


@dataclass(frozen=True)
class Futures:
    """The continuations that were tried at one step, several a motion.

    motions [N, T - t]: each begins with the motion it is for. poses [N, T - t, 3]: where they lead.
    preferred: what the first policy would do itself.
    """

    motions: Ints
    poses: Floats
    preferred: int


def futures(
    prefix: Prefix, body: Body, policies: Sequence[Proposer], tail: bytes | None, margin: float
) -> Futures:
    """Every continuation worth trying from x_t, t < T: the witness's tail, then what each policy proposes.

    tail: motions from x_t to the horizon, one a byte, T - t of them, re-simulated from the pose there is.
    """
    history, steps = prefix.poses, prefix.task.horizon - prefix.t
    margins = (margin, 0.0) if margin > 0.0 else (0.0,)  # what cannot be had with the margin may be without
    proposals = [policy.propose(history, prefix.signals, each) for each in margins for policy in policies]
    motions, poses = [p.motions for p in proposals], [p.poses for p in proposals]
    if tail is not None and len(tail) == steps:
        kept, after = np.frombuffer(tail, np.uint8).astype(np.int64)[None], np.empty((1, steps, 3))
        simulate(body, history[-1], kept[0], after[0])
        motions.insert(0, kept)
        poses.insert(0, after)
    if len(motions) == 1:
        return Futures(motions[0], poses[0], proposals[0].preferred)
    return Futures(np.concatenate(motions), np.concatenate(poses), proposals[0].preferred)


def together(tried: Futures, more: Futures) -> Futures:
    """Both, as `more` prefers."""
    motions, poses = np.concatenate([tried.motions, more.motions]), np.concatenate([tried.poses, more.poses])
    return Futures(motions, poses, more.preferred)


def rho(prefix: Prefix, tried: Futures) -> Floats:
    """The robustness of each future joined to the prefix, shape (N,).

    Raises SampleError where the formula's arithmetic is not finite on one.
    """
    values = np.empty(len(tried.motions))
    rate(prefix.view, prefix.known, prefix.t, tried.poses, prefix.rows[-1:], values)
    if np.isnan(values).any():
        before = np.broadcast_to(prefix.poses, (len(values), *prefix.poses.shape))
        samples = prefix.task.samples(np.concatenate([before, tried.poses], axis=1), prefix.signals)
        robustness(prefix.formula, {name: samples[name] for name in prefix.formula.names})
    return values


@dataclass(frozen=True)
class Best:
    """The most robust future of each motion. robustness [M]; row [M]: its row in `Futures`."""

    robustness: Floats
    row: Ints


def best_of(tried: Futures, values: Floats, motions: int) -> Best:
    """The future of each motion with the highest of `values` (N,), the lowest row on ties; each has one."""
    rows = np.empty(motions, np.int64)
    best_rows(tried.motions, values, rows)
    return Best(values[rows], rows)
