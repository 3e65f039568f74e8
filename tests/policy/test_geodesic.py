import math

import numpy as np
import pytest

from specshield.policy.geodesic import geodesic_distance


def one(shape, cell):
    mask = np.zeros(shape, bool)
    mask[cell] = True
    return mask


def test_open_floor_is_euclidean_within_two_percent():
    shape = (150, 170)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    exact = np.hypot(rows - 40, columns - 60) * 0.05
    found = geodesic_distance(np.ones(shape, bool), one(shape, (40, 60)), 0.05)
    assert found[40, 60] == 0
    assert np.all(found >= exact - 1e-12)
    assert np.all(found <= exact * 1.02)


def test_around_a_wall_by_hand():
    """From (10, 10) to (10, 50) past the end of a wall at column 30 that leaves the rows from 60 up free."""
    shape = (100, 80)
    free = np.ones(shape, bool)
    free[:60, 30] = False
    found = geodesic_distance(free, one(shape, (10, 10)), 1.0)
    exact = math.hypot(29.5 - 10, 59.5 - 10) + 1 + math.hypot(50 - 30.5, 59.5 - 10)
    assert found[10, 50] == pytest.approx(exact, rel=0.03)
    assert found[10, 50] >= exact - 1e-9


def test_where_no_way_leads_it_is_infinite():
    free = np.ones((20, 20), bool)
    free[:, 10] = False
    found = geodesic_distance(free, one(free.shape, (5, 5)), 0.1)
    assert np.all(np.isinf(found[:, 10:]))
    assert np.all(np.isfinite(found[:, :10]))
    corner = np.eye(2, dtype=bool)  # cells that meet at a corner only
    assert np.isinf(geodesic_distance(corner, one((2, 2), (0, 0)), 0.1)[1, 1])
    assert np.all(np.isinf(geodesic_distance(free, one(free.shape, (3, 10)), 0.1)))  # the goal is in the wall


def test_the_nearest_of_an_areas_cells_counts():
    free = np.ones((60, 60), bool)
    goal = np.zeros_like(free)
    goal[10:20, 10:20] = True
    found = geodesic_distance(free, goal, 1.0)
    assert np.all(found[goal] == 0)
    assert found[15, 50] == pytest.approx(31.0)
    assert found[49, 49] == pytest.approx(30 * math.sqrt(2), rel=0.02)
