"""A way after each first motion: one is searched for, and the other first motions join it where they can."""

from __future__ import annotations

import numpy as np

from specshield.arrays import Floats, Ints
from specshield.compiled import kernel, leaf
from specshield.policy.detour import join
from specshield.policy.planner.approach import BEAM_LENGTH, BEAM_WIDTH
from specshield.policy.planner.due_dates import foresee, is_open, make_bounds, read_signals
from specshield.policy.planner.exact import search_exactly
from specshield.policy.planner.search import MAX_DEPTH, Nodes, search, value
from specshield.policy.planner.way import Way, World, move, read_at, stay
from specshield.policy.progress import fill_signals
from specshield.policy.undo import IMPOSSIBLE, undo_motion
from specshield.robot.dynamics import motion_count
from specshield.rule.values import REGIONS
from specshield.stl.program import STACK_SIZE

# Shares of one plan's effort: for a search after a first motion other than the plan's, and for all such
# searches that find nothing if a robot has more than USUAL_MOTIONS. Chosen by hand.
SHARE, IN_VAIN, USUAL_MOTIONS, GOLDEN = 0.25, 16.0, 7, 0.618


@kernel
def make_way(world: World, t: int, steps: int, signals: Floats) -> Way:
    """Room for a way of so many steps from x_t. signals (S,): the values that they keep."""
    literals, size = world.literals, world.literals.formula.tree.size
    values = np.zeros(REGIONS + literals.formula.regions.plain.shape[0] + signals.shape[0])
    fill_signals(literals.formula.regions, signals, values)
    stack, held = np.empty(STACK_SIZE), np.empty(literals.leaf.shape[0])
    read_signals(literals, values, stack, held)
    return Way(
        t,
        np.empty(steps, np.int64),
        np.empty((steps + 1, 3)),
        np.empty(size),
        np.empty(literals.predicate.shape[0]),
        held,
        make_bounds(size),
        np.empty(size),
        values,
        stack,
        np.empty(motion_count(world.body)),
        np.empty((BEAM_LENGTH + 1, BEAM_WIDTH, 4)),
        np.empty((BEAM_LENGTH + 1, BEAM_WIDTH, 2), np.int64),
        np.zeros(1),
    )


@kernel
def make_nodes(literals: int, motions: int) -> Nodes:
    return Nodes(
        np.empty((MAX_DEPTH, 5), np.int64),
        np.empty((MAX_DEPTH, literals, 4), np.int64),
        np.empty((MAX_DEPTH, 6 * literals + motions, 5), np.int64),
    )


@leaf
def _rejoin(world: World, way: Way, base: Ints) -> bool:
    """Undoes the first motion and goes by `base` (T - t,), a way from x_t, with fewer waits. Returns whether
    the formula is satisfied.
    """
    back = undo_motion(world.body, way.poses[0], way.poses[1])
    if back == IMPOSSIBLE:
        return False
    join(back, -1, base, 0, world.pad, way.motions)
    for n in range(1, way.motions.shape[0]):
        move(world, way, n, way.motions[n])
    way.spent[0] += 0.3 * way.motions.shape[0]
    return value(world, way) > world.literals.margin


@kernel
def plan_all(
    world: World,
    t: int,
    pose: Floats,
    held: Floats,
    prefix: Floats,
    effort: float,
    without_plan: float,
    most: int,
    motions: Ints,
) -> tuple[int, bool]:
    """A way after each first motion, into motions (M, T - t); returns the motion that the plan from x_t
    takes, and whether there is a plan.

    held (S,): the values that signals keep; prefix (size,): the formula's leaves to step t; effort [about
    us]: of one plan; without_plan [about us]: of all searches after first motions while no plan is known;
    most: how many poses a search over exact poses may make. First a plan from x_t is looked for. Each other
    first motion is undone to go the same way. If that comes too late, a plan after that motion is looked for.
    """
    count, steps = motions.shape
    way = make_way(world, t, steps, held)
    nodes = make_nodes(world.literals.literal.shape[0], count)
    base, left, order = -1, np.inf, np.arange(count)
    if count > USUAL_MOTIONS:  # neighbours in the robot's list often fail alike, so others come in between
        left, order = IN_VAIN * effort, np.argsort(order * GOLDEN % 1.0)
    # First x_t itself (-2); then staying (-1), which others can use; then every other motion.
    for root in range(-2, count):
        m = world.pad if root < 0 else order[root]
        if root >= -1 and (m == base or (root >= 0 and m == world.pad)):
            continue
        way.known[:] = prefix
        way.spent[0] = 0.0
        way.poses[0] = pose
        n, found = 0, False
        if root >= -1:
            read_at(world, way, 0)
            move(world, way, 0, m)
            n = 1
            if base >= 0:
                found = _rejoin(world, way, motions[base])
        read_at(world, way, n)
        foresee(world.literals, t + n, way.known, way.held, way.bounds)
        if not found and min(left, without_plan) > 0.0 and is_open(world.literals, way.bounds):
            found = search(world, way, nodes, n, effort * (1.0 if n == 0 else SHARE))
            if not found and root == -2:
                found = search_exactly(world, way, nodes, effort, most)
        left -= 0.0 if root < 0 or found else way.spent[0] * count / USUAL_MOTIONS
        without_plan -= 0.0 if root < -1 or found else way.spent[0]
        if root == -2 and not found:
            continue
        m = way.motions[0] if root == -2 else m
        if found and base < 0:
            base, without_plan = m, np.inf
        if not found:
            stay(world, way, n, steps)
        motions[m] = way.motions
    return (base, True) if base >= 0 else (world.pad, False)
