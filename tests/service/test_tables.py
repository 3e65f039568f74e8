"""Tables for a session's own map."""

import numpy as np

from evaluation.shipped import shipped
from specshield.service.heavy.tables import Tables
from specshield.shield.decision import make_shield
from specshield.sim.cases import load_case
from specshield.world.learned import LearnedMap
from tests.serving import wait_for


def test_a_session_goes_on_without_tables_that_cannot_be_made_and_does_not_try_again_for_the_same_map():
    shield, tables = make_shield([shipped(load_case("case1"), "reachability")]), Tables()
    nowhere = np.array([shield.task.grid.occupied.size])  # no cell of the map
    for cells in (nowhere, nowhere + 1):
        known = LearnedMap(1, cells, np.array([True]), np.array([0]), np.array([0]))
        assert tables.of("a session", shield, known) == (shield, None)
        _, making = tables._making.peek("a session")
        wait_for(making.done)
        for _ in range(2):
            assert tables.of("a session", shield, known) == (shield, None)
            assert tables._making.peek("a session") is None
