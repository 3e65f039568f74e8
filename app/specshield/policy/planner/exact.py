"""The way to a literal by search over exact poses, where no descent of a field leads there in time.

A field of steps to go is made on a lattice: near a deadline it leads some steps astray, round a corner or
along what has to be kept out of. Here every pose that the robot's motions can reach is tried, by A* (Hart,
Nilsson and Raphael 1968): those first whose steps so far and steps to go are the fewest. The fields say how
many steps there are to go, and cut what is too late by more than they err. Poses that are nearly the same
count once, the one that is reached in the fewest steps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Int32s, Ints
from specshield.compiled import kernel, leaf
from specshield.policy.heap import Heap, pop, push
from specshield.policy.planner.due_dates import NO_DATE, read_pose
from specshield.policy.planner.fields import to_go_at
from specshield.policy.planner.search import Nodes, guard, search
from specshield.policy.planner.way import DUE, Way, World, holds, keeps, move, read_at
from specshield.robot.dynamics import around, motion_count, step_from

# Chosen by hand; python -m benchmarks.deadlines measures what is found.
NEAR = 3.0  # [steps] from where the field leads: nearer than this, poses are told apart by the finer grain
GRAIN, FINE = 0.1, 0.02  # [m] poses that differ by less, and by less than a degree, count once
GRAINS = (GRAIN, 0.03)  # [m] tried in turn: the coarse one can miss the few poses that lead through a gap
RICH = 100_000  # poses: with fewer left to try, only the first grain is tried. Chosen by hand
ASTRAY = 6.0  # [steps] by which the fields may err
OPTIMISM = 1.05  # the fields say a little less than there is to go
DEEPER = 1e-3  # [steps] by which a pose farther on its way goes before one that is as good
LEGS = 8  # literals that one way may go to like this, one after the other


class Tree(NamedTuple):
    """Poses [N, 3], the motions made up to each [N], its parent and the motion that led to it [N]. heap: of
    those to go on from; table: where poses are looked up.
    """

    pose: Floats
    made: Int32s
    parent: Int32s
    motion: Int32s
    heap: Heap
    table: Int32s


@kernel
def search_exactly(world: World, way: Way, nodes: Nodes, effort: float, most: int) -> bool:
    """As `search` from x_t, which has to have failed just before; goes on by it after each leg.

    most: the poses that the searches for all legs may make.
    """
    slots = 4
    while slots < 2 * most:
        slots *= 2
    tree = Tree(
        np.empty((most, 3)), np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most, np.int32),
        Heap(np.empty(most, np.int32), np.empty(most)), np.empty(slots, np.int32),
    )  # fmt: skip
    n, left = 0, most
    for _ in range(LEGS):
        due, before = nodes.need[0, :, DUE].copy(), n
        for k in np.argsort(due):
            k = int(k)
            if due[k] == NO_DATE or world.field[k, 0] < 0:
                continue
            read_at(world, way, n)
            if holds(world, k, way.rho):
                continue
            stop = int(min(way.motions.shape[0], due[k] - way.t))
            # A gap beside what has to be kept out of may be too narrow for the lattice, and so for the field
            # that leads round it, but not for the robot.
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
    return False


@leaf
def _reach(
    world: World, way: Way, k: int, f: int, n: int, stop: int, need: Ints, tree: Tree, most: int, grain: float
) -> tuple[int, int]:  # fmt: skip
    """Goes on from motions[:n] to where literal k holds, by motions[:stop] and by field f, and keeps what has
    to hold on the way. grain [m]: poses that differ by less count once, but not near the literal. How many
    motions there are then, -1 where it is not found; how many poses were made.
    """
    body = world.body
    tree.table[:] = -1
    for c in range(3):
        tree.pose[0, c] = way.poses[n, c]
    tree.made[0], tree.parent[0], tree.motion[0] = 0, -1, -1
    count, size = 1, push(tree.heap, 0, 0, 0.0)
    while size > 0 and count + motion_count(body) <= most:
        here = tree.heap.row[0]
        size = pop(tree.heap, size)
        made = tree.made[here] + 1
        if n + made > stop:
            continue
        x0, y0, theta0 = tree.pose[here, 0], tree.pose[here, 1], tree.pose[here, 2]
        cos, sin, room = around(body, x0, y0, theta0)
        for m in range(motion_count(body)):
            x, y, theta = step_from(body, x0, y0, theta0, cos, sin, room, m)
            if x == x0 and y == y0 and theta == theta0:
                continue
            ahead = to_go_at(body, world.fields, f, x, y, theta)
            if n + made + ahead > stop + ASTRAY:
                continue
            tree.pose[count, 0], tree.pose[count, 1], tree.pose[count, 2] = x, y, theta
            tree.made[count], tree.parent[count], tree.motion[count] = made, here, m
            if not _is_new(tree, count, FINE if ahead < NEAR else grain):
                continue
            read_pose(world.literals, x, y, theta, way.values, way.stack, way.rho)
            if not keeps(world, k, way.t + n + made, need, way.rho):
                continue
            if holds(world, k, way.rho):
                _write(world, way, n, tree, count)
                return n + made, count
            size = push(tree.heap, size, count, made + OPTIMISM * ahead - DEEPER * made)
            count += 1
    return -1, count


@leaf
def _write(world: World, way: Way, n: int, tree: Tree, row: int) -> None:
    """Writes the way to a row on from motions[:n]."""
    stop = n + tree.made[row]
    while tree.parent[row] >= 0:
        way.motions[n + tree.made[row] - 1] = tree.motion[row]
        row = tree.parent[row]
    read_at(world, way, n)
    for i in range(n, stop):
        move(world, way, i, way.motions[i])


@leaf
def _is_new(tree: Tree, row: int, grain: float) -> bool:
    """Whether nothing nearly the same as a row was reached in as few steps; the row is then remembered."""
    x, y, h = _rounded(tree.pose, row, grain)
    key = x * 73856093 ^ y * 19349663 ^ h * 83492791
    slot = (key ^ key >> 15) & (tree.table.shape[0] - 1)
    while tree.table[slot] >= 0:
        other = tree.table[slot]
        if _rounded(tree.pose, other, grain) == (x, y, h):
            if tree.made[other] <= tree.made[row]:
                return False
            break
        slot = (slot + 1) & (tree.table.shape[0] - 1)
    tree.table[slot] = row
    return True


@leaf
def _rounded(pose: Floats, row: int, grain: float) -> tuple[int, int, int]:
    x, y, h = pose[row, 0] / grain, pose[row, 1] / grain, math.degrees(pose[row, 2])
    return math.floor(x), math.floor(y), math.floor(h + 0.5)
