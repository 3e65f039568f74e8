import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from specshield.errors import MapError
from specshield.world.occupancy import MAX_SIDE, OccupancyGrid

SMALL = arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=9))
YAW = st.floats(-10, 10)


def nearest_obstacle(occupied, row, column):
    """Cells from a centre to the nearest occupied square, the ring around the grid included, one by one."""
    height, width = occupied.shape
    best = math.inf
    for i in range(-1, height + 1):
        for j in range(-1, width + 1):
            if not (0 <= i < height and 0 <= j < width) or occupied[i, j]:
                best = min(best, math.hypot(max(abs(i - row) - 0.5, 0), max(abs(j - column) - 0.5, 0)))
    return best


@given(SMALL)
def test_clearance_is_the_distance_to_the_nearest_square_or_the_outside(occupied):
    clearance = OccupancyGrid(occupied, 0.2).clearance
    expected = [
        [0.2 * nearest_obstacle(occupied, i, j) for j in range(occupied.shape[1])]
        for i in range(len(occupied))
    ]
    np.testing.assert_allclose(clearance, expected, rtol=0, atol=1e-12)


def test_clearance_by_hand():
    occupied = np.zeros((7, 9), bool)
    occupied[3, 4] = True
    clearance = OccupancyGrid(occupied, 1.0).clearance
    assert clearance[3, 4] == 0
    assert clearance[3, 2] == 1.5  # to the square's left side
    assert clearance[2, 3] == pytest.approx(math.sqrt(0.5))  # to its corner
    assert clearance[0, 0] == 0.5  # to the edge of the map


@given(SMALL, YAW, arrays(float, (5, 2), elements=st.floats(-100, 100)))
def test_frames_are_inverse_and_rigid(occupied, yaw, points):
    grid = OccupancyGrid(occupied, 0.05, (3.0, -2.0, yaw))
    np.testing.assert_allclose(grid.to_map(grid.to_grid(points)), points, atol=1e-9)
    apart = np.linalg.norm(points[0] - points[1])
    assert np.linalg.norm(np.subtract(*grid.to_grid(points[:2]))) == pytest.approx(apart, abs=1e-9)


def test_a_turned_grid_by_hand():
    grid = OccupancyGrid(np.zeros((2, 4), bool), 0.5, (1.0, 1.0, math.pi / 2))
    np.testing.assert_allclose(
        grid.to_grid([1.0, 2.0]), [1.0, 0.0], atol=1e-12
    )  # north of the corner: a column on
    np.testing.assert_allclose(grid.bounds, (0.0, 1.0, 1.0, 3.0), atol=1e-12)
    np.testing.assert_allclose(grid.centres[1, 3], [1 - 0.75, 1 + 1.75], atol=1e-12)


def test_equality_is_of_content_and_arrays_cannot_be_written():
    cells = np.eye(3, dtype=bool)
    grid = OccupancyGrid(cells, 0.1, (0, 0, 0))
    assert grid == OccupancyGrid(cells.copy(), 0.1, (-0.0, 0.0, 0.0))
    assert (
        len(
            {
                grid,
                OccupancyGrid(~cells, 0.1),
                OccupancyGrid(cells, 0.2),
                OccupancyGrid(cells, 0.1, (0, 1, 0)),
            }
        )
        == 4
    )
    assert OccupancyGrid(np.zeros((1, 8), bool), 1) != OccupancyGrid(np.zeros((8, 1), bool), 1)
    cells[0, 1] = True  # the caller's own array
    assert not grid.occupied[0, 1]
    for array in (grid.occupied, grid.clearance):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1


@pytest.mark.parametrize(
    ("cells", "resolution", "origin", "path"),
    [
        (np.zeros((1, MAX_SIDE + 1)), 0.1, (0, 0, 0), "width"),
        (np.zeros((MAX_SIDE + 1, 1)), 0.1, (0, 0, 0), "height"),
        (np.zeros((0, 3)), 0.1, (0, 0, 0), "height"),
        (np.zeros(3), 0.1, (0, 0, 0), "cells"),
        (np.zeros((2, 2)), 0.0, (0, 0, 0), "resolution"),
        (np.zeros((2, 2)), math.nan, (0, 0, 0), "resolution"),
        (np.zeros((2, 2)), 0.1, (0, 0), "origin"),
        (np.zeros((2, 2)), 0.1, (0, math.inf, 0), "origin[1]"),
    ],
)
def test_impossible_grids_are_refused(cells, resolution, origin, path):
    with pytest.raises(MapError) as caught:
        OccupancyGrid(cells, resolution, origin)
    assert caught.value.path == path
    assert caught.value.expected
