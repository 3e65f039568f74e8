"""A plan after each first motion: one is searched, and the others join it where they can."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel, leaf
from specshield.policy.detour import NONE, join, undoing
from specshield.policy.planner.approach import LENGTH, WIDTH, Work, World, move, read_at, stay
from specshield.policy.planner.due_dates import Bounds, foresee, is_open, read_signals
from specshield.policy.planner.search import DEEP, Nodes, search, value
from specshield.rule.values import REGIONS, fill_signals, region_count
from specshield.stl.program import STACK_SIZE

SHARE = 0.25  # of the effort of one plan: what a first motion may cost that the plan does not begin with

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@leaf
def _rejoin(world: World, t: int, base: Ints, motions: Ints, poses: Floats, work: Work) -> bool:
    """Undoes the first motion and goes by `base` (T - t,), a way from x_t; the steps lost are made up where
    it stays. Whether that satisfies the formula.
    """
    back = undoing(world.body, poses[0], poses[1])
    if back == NONE:
        return False
    join(back, -1, base, 0, world.pad, motions)
    for n in range(1, motions.shape[0]):
        move(world, t, n, motions[n], motions, poses, work)
    work.spent[0] += 0.3 * motions.shape[0]
    return value(world, work) > world.margin


@kernel
def propose_all(
    world: World,
    t: int,
    pose: Floats,
    signals: Floats,
    prefix: Floats,
    effort: float,
    motions: Ints,
    poses: Floats,
) -> tuple[int, bool]:
    """A continuation a first motion, into motions (M, T - t) and poses (M, T - t + 1, 3); returns the motion
    that the plan from x_t takes, and whether there is one.

    signals (S,): those held; prefix (size,): the formula's leaves to step t. One plan is made from x_t, if
    there is one. For the other first motions it is enough to undo them and go the same way; where that comes
    too late, they are planned for themselves.
    """
    agenda, (count, steps) = world.agenda, motions.shape
    size, literals, leaves = prefix.shape[0], agenda.literal.shape[0], agenda.leaf.shape[0]
    bounds = Bounds(np.empty(size), np.empty(size), np.empty(size), np.empty(size))
    values = np.zeros(REGIONS + region_count(agenda.rule.regions) + signals.shape[0])
    fill_signals(agenda.rule.regions, signals, values)
    work = Work(
        values, np.empty(STACK_SIZE), np.empty(agenda.predicate.shape[0]), np.empty(leaves), prefix.copy(),
        np.empty(size), bounds, np.empty(count), np.empty((LENGTH + 1, WIDTH, 4)),
        np.empty((LENGTH + 1, WIDTH, 2), np.int64), np.zeros(1),
    )  # fmt: skip
    nodes = Nodes(
        np.empty((DEEP, 5), np.int64), np.empty((DEEP, literals, 4), np.int64),
        np.empty((DEEP, 6 * literals + count, 5), np.int64),
    )  # fmt: skip
    read_signals(agenda, work.values, work.stack, work.held)
    way, places = np.empty(steps, np.int64), np.empty((steps + 1, 3))
    base = -1
    # x_t itself; staying, which others can fall back on; then every other motion.
    for root in range(-2, count):
        m = world.pad if root < 0 else root
        if root >= -1 and (m == base or (root >= 0 and m == world.pad)):
            continue
        work.known[:] = prefix
        work.spent[0] = 0.0
        places[0] = pose
        n, found = 0, False
        if root >= -1:
            read_at(world, places, 0, work)
            move(world, t, 0, m, way, places, work)
            n = 1
            if base >= 0:
                found = _rejoin(world, t, motions[base], way, places, work)
        read_at(world, places, n, work)
        foresee(agenda, t + n, work.known, work.held, work.bounds.low, work.bounds.high)
        if not found and is_open(agenda, -1, t + n, 0, 0, 0, world.margin, work.bounds):
            found = search(world, t, n, effort * (1.0 if n == 0 else SHARE), way, places, work, nodes)
        if root == -2 and not found:
            continue
        if root == -2:
            m = way[0]
        if found and base < 0:
            base = m
        if not found:
            stay(world, t, n, steps, way, places, work)
        motions[m], poses[m] = way, places
    return (base, True) if base >= 0 else (world.pad, False)
