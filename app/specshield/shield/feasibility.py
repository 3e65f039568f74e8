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

from specshield.policy.policy import Proposer
from specshield.robot.unicycle import Body, simulate
from specshield.stl import Formula, robustness
from specshield.task import Task

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Signals = Mapping[str, Floats]


@dataclass(frozen=True)
class Futures:
    """The joint trajectories that were tried at one step, several a motion.

    motions [N, T - t]: the continuations, each beginning with the motion it is for. trajectories
    [N, T + 1, 3]: the prefix x_{0:t} and what follows. preferred: what the first policy would do itself.
    """

    motions: Ints
    trajectories: Floats
    preferred: int


@dataclass(frozen=True)
class Best:
    """The most robust future of each motion. robustness [M]; row [M]: its row in `Futures`."""

    robustness: Floats
    row: Ints


def futures(
    task: Task,
    body: Body,
    policies: Sequence[Proposer],
    history: Floats,
    signals: Signals,
    tail: bytes | None,
    margin: float,
) -> Futures:
    """Every continuation worth trying from x_t: the stored witness's tail, then what each policy proposes.

    history [t + 1, 3], t < T. tail: motions from x_t to the horizon, one a byte, T - t of them, re-simulated
    from the pose there is.
    """
    steps = task.horizon + 1 - len(history)
    margins = (margin, 0.0) if margin > 0.0 else (0.0,)  # what cannot be had with the margin may be without
    proposals = [policy.propose(history, signals, each) for each in margins for policy in policies]
    motions, poses = [p.motions for p in proposals], [p.poses for p in proposals]
    if tail is not None and len(tail) == steps:
        kept, after = np.frombuffer(tail, np.uint8).astype(np.int64)[None], np.empty((1, steps, 3))
        simulate(body, history[-1], kept[0], after[0])
        motions.insert(0, kept)
        poses.insert(0, after)
    joined = np.concatenate(poses)
    prefix = np.broadcast_to(history, (len(joined), *history.shape))
    return Futures(np.concatenate(motions), np.concatenate([prefix, joined], axis=1), proposals[0].preferred)


def rho(task: Task, formula: Formula, tried: Futures, signals: Signals) -> Floats:
    """The robustness of each future, shape (N,), on the whole formula or on a part of it."""
    samples = task.samples(tried.trajectories, signals)
    values = robustness(formula, {name: samples[name] for name in formula.names})
    return np.broadcast_to(values, len(tried.motions))


def best_of(tried: Futures, values: Floats, motions: int) -> Best:
    """The future of each motion with the highest of `values` (N,), the lowest row on ties; each has one."""
    rows = np.empty(motions, np.int64)
    for m in range(motions):
        candidates = np.flatnonzero(tried.motions[:, 0] == m)
        rows[m] = candidates[np.argmax(values[candidates])]
    return Best(values[rows].copy(), rows)
