"""J: does a candidate action have a future that satisfies the formula? (paper, Def. 2 and eq. 6)

Proposers hand over motions. The shield simulates every row with f from x_t, joins it to the executed prefix
and computes the robustness of the joint trajectory: one future has to satisfy every conjunct. A future that
certifies an action is its witness.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Ints, copy_row
from specshield.compiled import Boxed, inlined, kernel
from specshield.robot.dynamics import Body, calmest_motion, motion_count, step
from specshield.rule.values import signal_rows
from specshield.rule.view import View, look, rate, read_step, recall_prefix, value_count, view_of
from specshield.shield.proposal import Proposer, ask
from specshield.stl import SATISFIED_ABOVE, Formula, robustness_bounds
from specshield.stl.program import STACK_SIZE
from specshield.stl.tree import tree_value
from specshield.task import Task

Signals = Mapping[str, Floats]
SLOTS = 8  # remembered motions for each step of a future: enough that few share one
NOT_FINITE = "the formula's arithmetic is not finite along some futures; these certify nothing"


class Prefix(NamedTuple):
    """What was driven, and what it says of a formula: rho lies in [low, high] however the robot goes on.

    poses [t + 1, 3]; steps: how many motions a future has, T - t. signals {name: [at most t + 1]}; rows
    [t + 1, S]: the signals as an array. held [1, S]: the values that the signals are taken to have from step
    t + 1 on.
    """

    task: Task
    formula: Formula
    poses: Floats
    signals: Signals
    rows: Floats
    view: Boxed[View]
    known: Floats  # the formula's leaves at the steps to t
    low: float
    high: float
    held: Floats
    t: int
    steps: int

    def of(self, formula: Formula, view: Boxed[View] | None = None) -> Prefix:
        """The same prefix for another formula, a part of the task's own; view: that of the formula."""
        view = view or view_of(self.task, formula)
        seen = prefix_of(self.task, formula, view, self.poses, self.signals)
        return seen._replace(held=self.held)

    def allows(self, pose: Floats) -> bool:
        """Whether the formula can still be kept if the next pose is this one (3,). False where its arithmetic
        is not finite there.
        """
        poses, known = np.concatenate([self.poses, pose[None]]), np.empty(self.view.value.tree.size)
        _, high = look(self.view, poses, self.foreseen, known)
        return bool(high > SATISFIED_ABOVE)

    @property
    def foreseen(self) -> Floats:
        """The signals [t + 2, S]: to step t, and the values that they are taken to keep from then on."""
        return np.concatenate([self.rows, self.held])


def prefix_of(task: Task, formula: Formula, view: Boxed[View], poses: Floats, signals: Signals) -> Prefix:
    """The prefix for `formula`, which is the task's own or a part of it; view: that of the formula.

    Raises SampleError where the formula's arithmetic is not finite on it.
    """
    rows = signal_rows(task, signals, len(poses))
    known = np.empty(view.value.tree.size)
    low, high = look(view, poses, rows, known)
    if low != low:
        samples = task.samples(poses, signals)
        robustness_bounds(formula, {name: samples[name] for name in formula.names})  # says what and where
    t, held = len(poses) - 1, rows[-1:]
    return Prefix(task, formula, poses, signals, rows, view, known, low, high, held, t, task.horizon - t)


class Futures(NamedTuple):
    """The futures that were tried at one step, several a motion, as the shield itself simulated them.

    motions [N, T - t]: a future belongs to its first motion. poses [N, T - t, 3]: where they lead. rho [N]:
    of each future joined to the prefix; -inf if its simulation was given up. leaves [N, size]: the values of
    the formula's leaves along each future that was not given up. preferred: the motion that the first
    proposer would make itself. warnings: which proposers were not used and why. prefix, body: what they were
    simulated and judged with. Only `simulated` and `together` write such arrays.
    """

    motions: Ints
    poses: Floats
    rho: Floats
    leaves: Floats
    preferred: int
    warnings: tuple[str, ...]
    prefix: Prefix
    body: Body


def futures(
    prefix: Prefix, body: Body, proposers: Sequence[Proposer], tail: bytes | None, margins: Sequence[float]
) -> Futures:
    """Every future worth trying from x_t, t < T: the witness's tail, then what each proposer proposes.

    tail: T - t motions from x_t to the horizon, one a byte; they are simulated anew from the robot's pose.
    margins: each proposer is asked for futures with each of them.
    """
    count, rows, warnings = len(prefix.task.robot.motions), [], []
    if tail is not None and len(tail) == prefix.steps:
        rows.append(np.frombuffer(tail, np.uint8).astype(np.int64)[None])
    preferred = None
    for margin in dict.fromkeys(margins):  # where no future has a margin, one without it may keep the rule
        for proposer in proposers:
            proposal, wrong = ask(proposer, prefix.poses, prefix.signals, margin, count, prefix.steps)
            if proposal is None:
                warnings.append(str(wrong))
                continue
            rows.append(proposal.motions)
            preferred = proposal.preferred if preferred is None else preferred
    if preferred is None:  # no proposer could be used: the shield can still try to stand
        still = calmest_motion(body)
        standing = np.full((count, prefix.steps), still)
        standing[:, 0] = np.arange(count)
        rows, preferred = [*rows, standing], still
    return simulated(prefix, body, rows, preferred, warnings)


def simulated(
    prefix: Prefix, body: Body, rows: Sequence[Ints], preferred: int, warnings: Sequence[str] = ()
) -> Futures:
    """The futures of motions, rows of arrays [n, T - t] that are in range: simulated and judged at once."""
    motions = np.concatenate(rows or [np.empty((0, prefix.steps), np.int64)])
    poses, rho = np.empty((*motions.shape, 3)), np.empty(len(motions))
    leaves = np.empty((len(motions), prefix.view.value.tree.size))
    violated = prefix.high <= SATISFIED_ABOVE  # then parts of the rule are judged, on every row as a whole
    known = prefix.view, prefix.known, prefix.t, prefix.poses[-1], prefix.held
    wait, written = prefix.task.robot.wait_motion, (motions, poses, rho, leaves)
    finite = _simulate_and_rate(body, *known, wait, not violated, *written)
    said = warnings if finite else [*warnings, NOT_FINITE]
    return Futures(motions, poses, rho, leaves, preferred, tuple(dict.fromkeys(said)), prefix, body)


def together(tried: Futures, more: Futures) -> Futures:
    """The futures of both, simulated with the same prefix and body; `more` says which motion is preferred."""
    if tried.prefix is not more.prefix or tried.body is not more.body:
        raise ValueError("these futures belong to different prefixes or bodies")
    arrays = (np.concatenate(both) for both in zip(tried[:4], more[:4], strict=True))
    said = tuple(dict.fromkeys([*tried.warnings, *more.warnings]))
    return Futures._make((*arrays, more.preferred, said, more.prefix, more.body))


def rho_of(prefix: Prefix, poses: Floats) -> tuple[Floats, Floats]:
    """rho (N,) of the prefix's formula along futures, poses [N, T - t, 3], and its leaves (N, size)."""
    values, leaves = np.empty(len(poses)), np.empty((len(poses), prefix.view.value.tree.size))
    rate(prefix.view, prefix.known, prefix.t, poses, prefix.held, values, leaves)
    return np.where(np.isnan(values), -np.inf, values), leaves


@kernel
def _simulate_and_rate(
    body: Body,
    boxed: Boxed[View],
    known: Floats,
    t: int,
    pose: Floats,
    held: Floats,
    wait: int,
    gives_up: bool,
    motions: Ints,
    poses: Floats,
    rho: Floats,
    leaves: Floats,
) -> bool:
    """Simulates each row of motions (N, T - t) from x_t, pose (3,), and computes rho (N,) of the joint
    trajectory; poses (N, T - t, 3) and leaves (N, tree.size) are written. False where the arithmetic was not
    finite on some row.

    known (tree.size,): the leaves of the prefix; held (1, S): the values that the signals keep; wait: the
    motion that leaves the pose as it is, -1 where the robot has none. With `gives_up`, a row is given up
    where the formula can no longer be satisfied on it and an earlier row of its first motion is at least as
    robust: rho is then -inf, and the poses that follow repeat the last.
    """
    view = boxed.value
    tree, steps, finite = view.tree, motions.shape[1], True
    values, stack, buffer = np.empty(value_count(view, held)), np.empty(STACK_SIZE), np.empty(tree.size)
    best = np.full(motion_count(body), -np.inf)
    # Most rows join the way of an earlier row at the very same pose, from where f has been computed already.
    met = np.full(1 << math.ceil(math.log2(SLOTS * steps)), -1, np.int64)
    for f in range(motions.shape[0]):
        first, row = motions[f, 0], poses[f]
        recall_prefix(view, known, t, buffer)
        x, y, theta = pose[0], pose[1], pose[2]
        k, whole = 0, True
        while k < steps and whole:
            m = motions[f, k]
            if m != wait:
                slot = _slot(x, y, theta, m, met.shape[0])
                g, j = met[slot] // steps, met[slot] % steps
                before = poses[g, j - 1] if j > 0 else pose
                same = before[0] == x and before[1] == y and before[2] == theta  # to the last bit
                if met[slot] >= 0 and motions[g, j] == m and same:
                    x, y, theta = poses[g, j, 0], poses[g, j, 1], poses[g, j, 2]
                else:
                    x, y, theta = step(body, x, y, theta, m)
                    met[slot] = f * steps + k
            row[k, 0], row[k, 1], row[k, 2] = x, y, theta
            least = read_step(view, row, held, t + 1, k, values, stack, buffer)
            if math.isnan(least):
                whole = finite = False
            elif gives_up and least <= SATISFIED_ABOVE and least <= best[first]:
                whole = False
            k += 1
        for rest in range(k, steps):
            row[rest, 0], row[rest, 1], row[rest, 2] = x, y, theta
        copy_row(buffer, leaves[f])
        rho[f] = tree_value(tree, buffer) if whole else -np.inf
        best[first] = max(best[first], rho[f])
    return finite


@inlined
def _slot(x: float, y: float, theta: float, motion: int, slots: int) -> int:
    """The slot for a motion from a pose: a hash (Teschner et al., 2003); `slots` is a power of two."""
    key = int(1e7 * x) * 73856093 ^ int(1e7 * y) * 19349663 ^ int(1e7 * theta) * 83492791 ^ motion * 40503
    return (key ^ key >> 17) & (slots - 1)


class Best(NamedTuple):
    """The most robust future of each motion.

    robustness [M]: -inf where no future was proposed. row [M]: its row in `Futures`, -1 where there is none.
    """

    robustness: Floats
    row: Ints


@kernel
def best_of(motions: Ints, values: Floats, count: int) -> Best:
    """For each of `count` motions, the future with the highest of `values` (N,); on ties, the lowest row.
    motions [N, T - t]: of the futures.
    """
    best = Best(np.full(count, -np.inf), np.full(count, -1))
    for f in range(motions.shape[0]):
        m = motions[f, 0]
        if best.row[m] < 0 or values[f] > best.robustness[m]:
            best.row[m], best.robustness[m] = f, values[f]
    return best
