"""A way under construction: motions and poses in exact simulation, with what the formula reads along them.

Every pose comes from f, and the predicates themselves say where a literal holds.
"""

from __future__ import annotations

from typing import NamedTuple

from specshield.arrays import Floats, Ints
from specshield.caution.surprise.barred import is_barred
from specshield.compiled import leaf
from specshield.policy.planner.due_dates import Bounds, note, read_pose
from specshield.policy.planner.fields import Fields
from specshield.policy.planner.literals import PREDICATE, SIDE, PackedLiterals
from specshield.robot.dynamics import Body, step

# The columns of `need`, for each literal: DUE, the step by which it has to hold once; BEGIN and UNTIL, the
# steps between which it has to hold throughout; UNTIL_GOAL, the step to which it has to hold as long as the
# literal that the robot goes to does not.
DUE, BEGIN, UNTIL, UNTIL_GOAL = range(4)


class World(NamedTuple):
    """What a search reads.

    field [L, 2]: the field that leads to each literal freely, and the one that keeps what has to hold for a
    while; -1 for none. band: how far the fields may err [steps]. pad: the motion that stays, or comes nearest
    to it; stands: whether it stays. cost: of one evaluation of the formula [about us]. barred [n, 6]: motions
    that are taken to lead nowhere (caution/surprise/barred.py).
    """

    body: Body
    fields: Fields
    literals: PackedLiterals
    field: Ints
    band: float
    pad: int
    stands: bool
    cost: float
    barred: Floats


class Way(NamedTuple):
    """A way from x_t to the horizon, which is written motion by motion, and scratch arrays for that.

    t: the step of x_t. motions (T - t,); poses (T - t + 1, 3), beginning with x_t; known (size,): all leaves
    along the way. rho (P,): the predicates at the pose read last; held (l,): the leaves that read signals
    alone. buffer (size,), values, stack: scratch of evaluations; scores (M,): of motions. places [length +
    1, width, 4], trail [length + 1, width, 2]: a beam's poses with their steps to go, and each one's parent
    and motion. spent (1,): what the search has cost so far [about us].
    """

    t: int
    motions: Ints
    poses: Floats
    known: Floats
    rho: Floats
    held: Floats
    bounds: Bounds
    buffer: Floats
    values: Floats
    stack: Floats
    scores: Floats
    places: Floats
    trail: Ints
    spent: Floats


@leaf
def holds(world: World, k: int, rho: Floats) -> bool:
    """Whether literal k holds where the predicates are rho (P,)."""
    literals = world.literals
    return bool(literals.literal[k, SIDE] * rho[literals.literal[k, PREDICATE]] > literals.margin)


@leaf
def keeps(world: World, goal: int, at: int, need: Ints, rho: Floats) -> bool:
    """Whether everything that has to hold at step `at`, on the way to a goal, does. need (L, 4)."""
    kept, there = True, holds(world, goal, rho)
    for k in range(need.shape[0]):
        asked = need[k, BEGIN] <= at <= need[k, UNTIL] or (at <= need[k, UNTIL_GOAL] and not there)
        kept = kept and (not asked or holds(world, k, rho))
    return kept


@leaf
def read_at(world: World, way: Way, n: int) -> None:
    """Writes the predicates at poses[n] into way.rho."""
    x, y, theta = way.poses[n, 0], way.poses[n, 1], way.poses[n, 2]
    read_pose(world.literals, x, y, theta, way.values, way.stack, way.rho)


@leaf
def note_at(world: World, way: Way, n: int) -> None:
    """Writes the leaves at poses[n], whose predicates are in way.rho, into way.known."""
    note(world.literals, way.t + n, way.rho, way.held, way.known)


@leaf
def lead(world: World, x: float, y: float, theta: float, motion: int) -> tuple[float, float, float]:
    """Where a motion leads from a pose."""
    if is_barred(world.barred, x, y, theta, motion):
        return x, y, theta
    return step(world.body, x, y, theta, motion)


@leaf
def move(world: World, way: Way, n: int, motion: int) -> None:
    """Makes `motion` the nth. way.rho has to hold the predicates at poses[n]; then it has those after it."""
    poses = way.poses
    x, y, theta = lead(world, poses[n, 0], poses[n, 1], poses[n, 2], motion)
    way.motions[n] = motion
    poses[n + 1, 0], poses[n + 1, 1], poses[n + 1, 2] = x, y, theta
    if x != poses[n, 0] or y != poses[n, 1] or theta != poses[n, 2]:
        read_at(world, way, n + 1)
    note_at(world, way, n + 1)


@leaf
def stay(world: World, way: Way, n: int, stop: int) -> None:
    """Stays from motions[:n] to motions[:stop], or does what comes nearest to it."""
    read_at(world, way, n)
    for i in range(n, stop):
        move(world, way, i, world.pad)
