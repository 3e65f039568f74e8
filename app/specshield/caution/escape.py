"""The quickest way out of a place where a broken G forbids the robot to be.

A breadth-first search over f from x_t: one layer of poses a step, those that are nearest to being out first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.arrays import Floats, Ints
from specshield.compiled import kernel
from specshield.robot.dynamics import Body, motion_count, successors
from specshield.shield.decision import Shield
from specshield.shield.feasibility import Futures, Prefix, simulated
from specshield.shield.proposal import ask
from specshield.stl import SATISFIED_ABOVE, Always, robustness

# Chosen by hand, so that one search costs some milliseconds; tests/caution/test_escape.py says what is found.
POSES_A_LAYER = 1024  # poses that are simulated at each step of the search, about
LONGEST_ESCAPE = 24  # [steps] ways out that take longer are not searched for
ESCAPES = 4  # ways out that are continued to the horizon: each of them asks every proposer
POSES_A_METRE = 1e3  # [1/m, 1/rad] poses that agree when rounded to this grid count as one
SPAN, TURN = 1 << 20, 1 << 13  # more than such a grid has points in a kilometre, and in a full turn


class Layer(NamedTuple):
    """Poses that are the same number of steps from x_t.

    pose [N, 3]; root [N]: the first motion of the way to each; motion [N]: the last one; parent [N]: the row
    of the layer before that it comes from.
    """

    pose: Floats
    root: Ints
    motion: Ints
    parent: Ints


def escape(
    shield: Shield, prefix: Prefix, broken: Sequence[Always], kept: Sequence[Always]
) -> tuple[int, Futures | None]:
    """Searches for ways on which every formula of `broken` holds again.

    Returns the fewest steps that such a way takes, 0 where none was found, and futures to the horizon: the
    ways found, or else the way that came nearest to being out, each continued as the proposers propose. The
    futures are None where one step is enough, since then the futures of the decision hold such ways already.
    Ways that break a formula of `kept` are taken only where there are no others. Each way begins with another
    motion. The signals keep their last values.
    """
    for guards in (kept, ()) if kept else ((),):
        steps, ways = _search(shield.body, prefix, broken, guards)
        if steps > 0:
            break
    return steps, _onward(shield, prefix, ways) if steps != 1 and ways else None


def _search(
    body: Body, prefix: Prefix, broken: Sequence[Always], guards: Sequence[Always]
) -> tuple[int, list[tuple[Ints, Floats]]]:
    """The fewest steps out, and some ways that take that many, each beginning with another motion.

    The steps are 0 where no way of LONGEST_ESCAPE steps leads out; the way is then the one that came nearest.
    """
    root, motion = np.zeros(1, np.int64), np.full(1, -1)
    layers = [Layer(prefix.poses[-1:], root, motion, root)]
    width = max(POSES_A_LAYER // motion_count(body), motion_count(body))
    for k in range(1, min(LONGEST_ESCAPE, prefix.task.horizon - prefix.t) + 1):
        layer = _expand(body, layers[-1])
        layer = _rows(layer, holding(prefix, guards, layer.pose, prefix.t + k) > SATISFIED_ABOVE)
        if not len(layer.pose):
            break
        out = holding(prefix, broken, layer.pose, prefix.t + k)
        order = np.argsort(-out, kind="stable")
        if out[order[0]] > SATISFIED_ABOVE:
            best = order[out[order] > SATISFIED_ABOVE]
            _, first = np.unique(layer.root[best], return_index=True)
            return k, [_trace([*layers, layer], int(end)) for end in best[np.sort(first)[:ESCAPES]]]
        layers.append(_rows(layer, order[:width]))
    return 0, [_trace(layers, 0)] if len(layers) > 1 else []


def _rows(layer: Layer, which: NDArray[Any]) -> Layer:
    return Layer(*(column[which] for column in layer))


def _expand(body: Body, layer: Layer) -> Layer:
    """Every motion from every pose. Of poses that are alike, one is kept for each first motion."""
    count = motion_count(body)
    pose = spread(body, layer.pose)
    motion, parent = np.tile(np.arange(count), len(layer.pose)), np.repeat(np.arange(len(layer.pose)), count)
    root = motion if layer.motion[0] < 0 else layer.root[parent]
    at = np.rint(POSES_A_METRE * pose).astype(np.int64)
    x, y, theta = (at - at.min(axis=0)).T
    _, once = np.unique(((root * TURN + theta) * SPAN + x) * SPAN + y, return_index=True)
    once.sort()
    return Layer(pose[once], root[once], motion[once], parent[once])


@kernel
def spread(body: Body, poses: Floats) -> Floats:
    """Where each motion leads from each of poses (n, 3): from one pose after the other, (n M, 3)."""
    out = np.empty((poses.shape[0], motion_count(body), 3))
    for i in range(poses.shape[0]):
        successors(body, poses[i], out[i])
    return out.reshape(-1, 3)


def holding(prefix: Prefix, formulas: Sequence[Always], poses: Floats, t: int) -> Floats:
    """The least rho of the children of formulas whose window holds step t, at each pose [N]; inf for none."""
    least = np.full(len(poses), np.inf)
    now = {name: values[-1:] for name, values in prefix.signals.items()}
    samples = prefix.task.samples(poses[:, None], now)
    for formula in formulas:
        if formula.a <= t <= formula.b:
            child = formula.child
            least = np.minimum(least, robustness(child, {n: samples[n] for n in child.names}))
    return least


def _trace(layers: Sequence[Layer], at: int) -> tuple[Ints, Floats]:
    """The motions and poses of the way to row `at` of the last layer."""
    motions, poses = [], []
    for layer in reversed(layers[1:]):
        motions.append(layer.motion[at])
        poses.append(layer.pose[at])
        at = int(layer.parent[at])
    return np.array(motions[::-1]), np.array(poses[::-1])


def _onward(shield: Shield, prefix: Prefix, ways: Sequence[tuple[Ints, Floats]]) -> Futures:
    """The ways continued to the horizon: from the end of each by what the proposers propose there."""
    rows, warnings, count = list[Ints](), list[str](), motion_count(shield.body)
    for taken, reached in ways:
        k, left = len(taken), prefix.steps - len(taken)
        if left == 0:
            rows.append(taken[None])
            continue
        history = np.concatenate([prefix.poses, reached])
        signals = {n: np.append(v, np.full(k, v[-1])) for n, v in prefix.signals.items()}
        for proposer in shield.proposers:
            proposal, wrong = ask(proposer, history, signals, 0.0, count, left)
            found = [] if proposal is None else [proposal.motions]
            rows.extend(np.hstack([np.tile(taken, (len(each), 1)), each]) for each in found)
            warnings.extend([] if wrong is None else [wrong])
    return simulated(prefix, shield.body, rows, int(ways[0][0][0]), warnings)
