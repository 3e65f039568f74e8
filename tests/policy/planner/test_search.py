"""Limited discrepancy search on a few cells against the search of every future."""

import numpy as np
import pytest

from specshield.policy.planner.search import search, value
from tests.oracles.cells import FORWARD, LEFT, WAIT, Cells
from tests.policy.planner.worlds import cells_of, plan_from

EAST, NORTH, WEST, SOUTH = range(4)
STARTS = [(i, j, h) for i, j in ((0, 0), (0, 3), (2, 2), (2, 4), (4, 3)) for h in range(4)]

ORDER = Cells(  # B is due first and lies the other way
    "F[0,7] A and F[0,4] B and G[0,7] not C",
    lambda s: s["A"].any(-1) & s["B"][..., :5].any(-1) & ~s["C"].any(-1),
    {"A": (2, 0), "B": (2, 2), "C": (0, 1)},
)
LEAVE = Cells(  # to be in A at three steps, then out of it
    "F[1,3] G[1,3] A and G[6,7] not A",
    lambda s: (
        s["A"][..., 2:5].all(-1) & ~s["A"][..., 6:].any(-1)
        | s["A"][..., 3:6].all(-1) & ~s["A"][..., 6:].any(-1)
        | s["A"][..., 4:7].all(-1) & ~s["A"][..., 6:].any(-1)
    ),
    {"A": (2, 2)},
)


@pytest.mark.parametrize("cells", [ORDER, LEAVE], ids=["order", "leave"])
def test_it_finds_a_way_exactly_where_there_is_one(cells):
    found = 0
    for state in STARTS:
        world, way, nodes = plan_from(cells, state)
        _, kept = cells.futures([cells.pose(*state)])
        assert search(world, way, nodes, 0, 1e4) == kept.any()
        if kept.any():
            states = [state]
            for motion in way.motions:
                states.append(cells.after(states[-1], motion))
            assert cells.kept([cells.pose(*each) for each in states])
            found += 1
    assert 2 < found < len(STARTS)


def test_a_way_goes_stays_and_goes_on():
    """Two cells ahead to A, two steps to stay there, then to B: a turn and two cells ahead."""
    cells = cells_of("F[0,2] G[0,2] A and F[7,7] B", places={"A": (2, 2), "B": (2, 4)})
    world, way, nodes = plan_from(cells, (0, 2, EAST))
    assert search(world, way, nodes, 0, 1e4)
    assert way.motions.tolist() == [FORWARD, FORWARD, WAIT, WAIT, LEFT, FORWARD, FORWARD]
    assert value(world, way) == pytest.approx(0.1)  # the middle of a cell is 0.1 m inside it


def test_the_effort_is_counted_and_ends_the_search():
    """B cannot be reached in time, so a search goes on until it has spent what it may."""
    cells = cells_of("F[0,8] A and F[0,8] B and F[3,8] C")
    spent = []
    for effort in (20.0, 200.0):
        world, way, nodes = plan_from(cells, (4, 4, EAST))
        assert not search(world, way, nodes, 0, effort)
        spent.append(way.spent[0])
    assert spent == sorted(spent)
    assert np.all(np.array(spent) < 1e4)
