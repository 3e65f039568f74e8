"""What the planner's parts are tried on: the robot on whole cells, and no more than a part needs."""

from __future__ import annotations

import numpy as np

from specshield.policy.planner.due_dates import NO_DATE, foresee, make_bounds, note
from specshield.policy.planner.first_motions import make_nodes, make_way
from specshield.policy.planner.literals import literals_of
from specshield.policy.planner.method import Settings
from specshield.policy.planner.policy import synthesise
from specshield.policy.planner.way import BEGIN, DUE, UNTIL, UNTIL_GOAL, read_at
from specshield.policy.progress import initial_signals
from tests.oracles.cells import MOTIONS, Cells

PLACES = {"A": (0, 4), "B": (2, 1), "C": (0, 2)}  # column and row


def cells_of(formula, signals=(), places=PLACES):
    """The cells with a formula that is not worked out again."""
    used = {name: cell for name, cell in places.items() if name in formula}
    return Cells(formula, None, used, dict(signals))


def literal_of(cells, name, side):
    """The number of the literal that is a region's predicate (1) or its negation (-1)."""
    _, literals = literals_of(cells.task, cells.task.formula)
    return [(str(each.predicate), each.side) for each in literals].index((name, side))


def bounds_after(cells, inside, held=()):
    """The packed literals and the leaves' bounds after a prefix. inside {name: [booleans]}, one a step."""
    packed, literals = literals_of(cells.task, cells.task.formula)
    size, held = packed.formula.tree.size, np.array(held or [0.0] * len(packed.leaf))
    known, bounds, names = np.zeros(size), make_bounds(size), [str(each.predicate) for each in literals]
    steps = len(next(iter(inside.values()), ()))
    for t in range(steps):
        rho = np.zeros(len(packed.predicate))
        for k, row in enumerate(packed.literal):
            rho[row[0]] = 1.0 if inside[names[k]][t] else -1.0
        note(packed, t, rho, held, known)
    foresee(packed, steps - 1, known, held, bounds)
    return packed, bounds, steps - 1


def plan_from(cells, state):
    """The planner's world, a way that begins at a state of the cells, and room for the nodes of a search."""
    world = synthesise(cells.task, Settings(pitch=0.2))._world
    way = make_way(world, 0, cells.task.horizon, initial_signals(cells.task))
    way.poses[0] = cells.pose(*state)
    read_at(world, way, 0)
    note(world.literals, 0, way.rho, way.held, way.known)
    return world, way, make_nodes(len(world.literals.literal), MOTIONS)


def nothing_needed(world):
    """What is needed of the literals, where that is nothing."""
    need = np.full((len(world.literals.literal), 4), -1, np.int64)
    need[:, [DUE, BEGIN]] = NO_DATE
    assert (DUE, BEGIN, UNTIL, UNTIL_GOAL) == (0, 1, 2, 3)
    return need
