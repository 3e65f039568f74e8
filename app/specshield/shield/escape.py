"""The quickest way out of where a broken G forbids the robot to be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel
from specshield.robot.unicycle import Body, successors
from specshield.shield.decision import Shield
from specshield.shield.feasibility import Futures, Prefix
from specshield.stl import SATISFIED_ABOVE, Always, robustness

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

WIDTH = 64  # poses kept after each first motion: those nearest to being out
LONGEST = 64  # [steps]
ALIKE = 1e3  # [1/m, 1/rad] poses as near as a millimetre count as one


class Layer(NamedTuple):
    """Poses so many steps from x_t. pose [N, 3]; root, motion [N]: the first motion and the last; parent [N]:
    the row of the layer before.
    """

    pose: Floats
    root: Ints
    motion: Ints
    parent: Ints


def escape(shield: Shield, prefix: Prefix, broken: Sequence[Always]) -> tuple[int, Futures | None]:
    """How many steps it takes at least until every `broken` holds again, 0 where no way was found; and, where
    it takes more than one, such ways with what the policies propose from their ends.

    At most one way for each first motion. The signals keep their last values.
    """
    if any(each.child.horizon > 0 for each in broken):
        return 0, None
    room = min(LONGEST, *(each.b - prefix.t for each in broken))
    root, motion = np.zeros(1, np.int64), np.full(1, -1)
    layers = [Layer(prefix.poses[-1:], root, motion, root)]
    while len(layers) <= room:
        layer = _expand(shield.body, layers[-1])
        out = _holds(prefix, broken, layer.pose)
        free = np.flatnonzero(out > SATISFIED_ABOVE)
        if len(free):
            best = free[np.argsort(-out[free], kind="stable")]
            _, first = np.unique(layer.root[best], return_index=True)
            ends = best[np.sort(first)]
            k = len(layers)
            ways = [_trace([*layers, layer], int(end)) for end in ends]
            return k, None if k == 1 else _onward(shield, prefix, ways)
        layers.append(_keep(layer, out))
    return 0, None


def _expand(body: Body, layer: Layer) -> Layer:
    """Every motion from every pose, those alike once for each first motion."""
    count = len(body.translate)
    pose = np.empty((len(layer.pose) * count, 3))
    _successors(body, layer.pose, pose)
    motion, parent = np.tile(np.arange(count), len(layer.pose)), np.repeat(np.arange(len(layer.pose)), count)
    root = motion if layer.motion[0] < 0 else layer.root[parent]
    _, once = np.unique(np.column_stack([root, np.rint(ALIKE * pose)]), axis=0, return_index=True)
    once.sort()
    return Layer(pose[once], root[once], motion[once], parent[once])


@kernel
def _successors(body: Body, poses: Floats, out: Floats) -> None:
    count = body.translate.shape[0]
    for i in range(poses.shape[0]):
        successors(body, poses[i], out[i * count : (i + 1) * count])


def _holds(prefix: Prefix, broken: Sequence[Always], poses: Floats) -> Floats:
    """By how much all of what is broken would hold at each pose [N]."""
    now = {name: values[-1:] for name, values in prefix.signals.items()}
    samples = prefix.task.samples(poses[:, None], now)
    held = [robustness(each.child, {n: samples[n] for n in each.child.names}) for each in broken]
    least: Floats = np.min(held, axis=0)
    return least


def _keep(layer: Layer, out: Floats) -> Layer:
    """Those nearest to being out, WIDTH for each first motion."""
    order = np.argsort(-out, kind="stable")
    rank = np.empty(len(order), np.int64)
    for root in np.unique(layer.root):
        own = order[layer.root[order] == root]
        rank[own] = np.arange(len(own))
    kept = np.flatnonzero(rank < WIDTH)
    return Layer(layer.pose[kept], layer.root[kept], layer.motion[kept], layer.parent[kept])


def _trace(layers: Sequence[Layer], at: int) -> tuple[Ints, Floats]:
    """The motions and poses of the way to row `at` of the last layer."""
    motions, poses = [], []
    for layer in reversed(layers[1:]):
        motions.append(layer.motion[at])
        poses.append(layer.pose[at])
        at = int(layer.parent[at])
    return np.array(motions[::-1]), np.array(poses[::-1])


def _onward(shield: Shield, prefix: Prefix, ways: Sequence[tuple[Ints, Floats]]) -> Futures:
    """The ways to the horizon: from the end of each by what the policies propose there."""
    motions, poses = [], []
    for taken, reached in ways:
        k = len(taken)
        if prefix.t + k == prefix.task.horizon:
            motions.append(taken[None])
            poses.append(reached[None])
            continue
        history = np.concatenate([prefix.poses, reached])
        signals = {n: np.append(v, np.full(k, v[-1])) for n, v in prefix.signals.items()}
        for policy in shield.policies:
            proposal = policy.propose(history, signals, 0.0)
            rows = len(proposal.motions)
            motions.append(np.hstack([np.tile(taken, (rows, 1)), proposal.motions]))
            poses.append(np.hstack([np.tile(reached, (rows, 1, 1)), proposal.poses]))
    return Futures(np.concatenate(motions), np.concatenate(poses), int(ways[0][0][0]))
