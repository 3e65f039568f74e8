"""The way to a literal by search over exact poses, for when no descent of a field leads there in time.

A field of steps to go is made on a lattice: round a corner or along a forbidden place it may lead some steps
astray, too many near a deadline. Here every pose that the robot's motions can reach is tried, by A* (Hart,
Nilsson and Raphael, 1968): first those with the least sum of the steps so far and the steps to go. The fields
give the steps to go; poses that are too late by more than the fields err are left out. Of poses that are
nearly the same, the one that is reached in the fewest steps counts.

A passage hardly wider than the robot may lie between the points of the lattice. A pose from which the field
knows no way counts as near to the goal as the pose before it.
"""

from __future__ import annotations

import numpy as np

from specshield.arrays import Ints
from specshield.caution.surprise.barred import is_barred
from specshield.compiled import kernel, leaf
from specshield.policy.planner.due_dates import NO_DATE, foresee, is_open, read_pose
from specshield.policy.planner.fields import OUT_OF_REACH, to_go_at
from specshield.policy.planner.search import Nodes, guard, search
from specshield.policy.planner.way import DUE, Way, World, holds, keeps, move, read_at, stay
from specshield.policy.tree import DEGREE, Grain, Tree, enter, make_tree, pop, push, put, trace
from specshield.robot.dynamics import around, motion_count, step_from

# Chosen by hand; python -m benchmarks.deadlines measures what is found.
NEAR = 3.0  # [steps] from where the field leads: nearer than this, the finer grain applies
GRAIN, FINE = 0.1, 0.02  # [m] poses that differ by less, and by less than a degree, count once
GRAINS = (GRAIN, 0.03)  # [m] tried in turn: the coarse one can miss the few poses that lead through a gap
RICH = 100_000  # poses: with fewer left to try, only the first grain is tried. Chosen by hand
ASTRAY = 6.0  # [steps] by which the fields may err
OPTIMISM = 1.05  # the fields say a little less than there is to go
DEEPER = 1e-3  # [steps] the advantage, for each step made, of a pose farther on its way over one as good
# poses, at most, where the field knows no way from the first one: enough for a small floor. To refuse a start
# in a closed room took 220 ms without this bound, and 16 ms with it (own script).
UNSEEN = 10_000
LEGS = 8  # literals that one way may go to by such searches, one after the other


@kernel
def search_exactly(world: World, way: Way, nodes: Nodes, effort: float, most: int) -> bool:
    """Goes to one literal after the other by searches over exact poses, and after each calls `search` for the
    rest of the way. If that fails, it is called for the same way after waits, which ends just in time: what
    begins at the literal begins later then, as a response does. To be called right after `search` from x_t
    has failed; the result is that of `search`.

    most: how many poses the searches for all legs may make.
    """
    tree, n, left = make_tree(most, 0), 0, most
    for _ in range(LEGS):
        due, before = nodes.need[0, :, DUE].copy(), n
        choice = (due == NO_DATE).all()  # of several literals, any of which may fail
        for k in np.argsort(due):
            k = int(k)
            if (due[k] == NO_DATE and not choice) or world.field[k, 0] < 0:
                continue
            read_at(world, way, n)
            if holds(world, k, way.rho):
                continue
            stop = int(min(way.motions.shape[0], due[k] - way.t))
            # A gap beside a forbidden place may be too narrow for the lattice, and so for the field that
            # keeps out of that place, but not for the robot.
            guarding = guard(world, way, k, n, way.t + stop, nodes.need[0])
            for column in range(1, -1, -1):
                same = world.field[k, 0] == world.field[k, 1]
                if n > before or (column == 1 and (same or not guarding)):
                    continue
                for grain in GRAINS:
                    if n > before or (grain < GRAIN and left < RICH):
                        continue
                    most = left // 2 if column == 1 else left
                    after, made = _reach(
                        world, way, k, world.field[k, column], n, stop, nodes.need[0], tree, most, grain
                    )
                    n, left = max(n, after), left - made
            if n > before:
                break
        if n == before:
            return False
        if search(world, way, nodes, n, effort):
            return True
        went, late = way.motions[before:n].copy(), stop - n if world.stands else 0
        open_late = late > 0 and _is_open_after(world, way, before, late, went)
        if open_late and search(world, way, nodes, stop, effort):
            return True
        _is_open_after(world, way, before, 0, went)
    return False


@leaf
def _is_open_after(world: World, way: Way, n: int, waits: int, motions: Ints) -> bool:
    """Goes on from motions[:n]: waits so many steps, then makes `motions`. Returns whether the formula can
    still be satisfied then, as far as the bounds can tell.
    """
    stay(world, way, n, n + waits)
    n += waits
    for motion in motions:
        move(world, way, n, motion)
        n += 1
    foresee(world.literals, way.t + n, way.known, way.held, way.bounds)
    return is_open(world.literals, way.bounds)


@leaf
def _reach(
    world: World, way: Way, k: int, f: int, n: int, stop: int, need: Ints, tree: Tree, most: int, grain: float
) -> tuple[int, int]:
    """Goes on from motions[:n] to where literal k holds, guided by field f, and keeps what has to hold on the
    way. Returns how many motions there are then, -1 if no way within `stop` motions is found; and how many
    poses were made. grain [m]: poses that differ by less count once; near the literal FINE is used instead.
    """
    body = world.body
    tree.table[:] = -1
    put(tree, 0, way.poses[n, 0], way.poses[n, 1], way.poses[n, 2], 0, -1, -1)
    ahead = to_go_at(body, world.fields, f, way.poses[n, 0], way.poses[n, 1], way.poses[n, 2])
    seen = ahead < OUT_OF_REACH
    most = most if seen else min(most, UNSEEN)
    count, size = 1, push(tree.heap, 0, 0, OPTIMISM * ahead if seen else 0.0)
    while size > 0 and count + motion_count(body) <= most:
        here, rank = tree.heap.row[0], tree.heap.rank[0]
        size = pop(tree.heap, size)
        made = tree.made[here] + 1
        from_here = (rank - (1.0 - DEEPER) * (made - 1)) / OPTIMISM
        if n + made > stop:
            continue
        x0, y0, theta0 = tree.pose[here, 0], tree.pose[here, 1], tree.pose[here, 2]
        cos, sin, room = around(body, x0, y0, theta0)
        for m in range(motion_count(body)):
            x, y, theta = step_from(body, x0, y0, theta0, cos, sin, room, m)
            if (x == x0 and y == y0 and theta == theta0) or is_barred(world.barred, x0, y0, theta0, m):
                continue
            ahead = to_go_at(body, world.fields, f, x, y, theta)
            ahead = ahead if ahead < OUT_OF_REACH else from_here
            if n + made + ahead > stop + ASTRAY:
                continue
            put(tree, count, x, y, theta, made, here, m)
            slot = enter(tree, count, Grain(1.0, FINE if ahead < NEAR else grain, DEGREE), True)
            if slot < 0:
                continue
            read_pose(world.literals, x, y, theta, way.values, way.stack, way.rho)
            if not keeps(world, k, way.t + n + made, need, way.rho):
                tree.table[slot] = -1  # its row is used again
                continue
            if holds(world, k, way.rho):
                trace(tree, count, way.motions[n:])
                read_at(world, way, n)
                for i in range(n, n + made):
                    move(world, way, i, way.motions[i])
                return n + made, count
            size = push(tree.heap, size, count, made + OPTIMISM * ahead - DEEPER * made)
            count += 1
    return -1, count
