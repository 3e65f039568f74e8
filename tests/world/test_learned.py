"""The session's own map: what changes it, what does not, and that it survives being stored."""

from __future__ import annotations

import numpy as np
import pytest

from specshield.errors import SampleError
from specshield.world.learned import LearnedMap, applied, cells_of, check_points, forget, learn, revised
from specshield.world.occupancy import OccupancyGrid

WALL = np.zeros((4, 5), bool)
WALL[:, 2] = True
GRID = OccupancyGrid(WALL, 0.1, (1.0, 2.0, np.pi / 2))  # its columns run along y, its rows along -x


def at(row, column):
    return GRID.centres[row, column]


def cells(*places):
    return cells_of(GRID, np.array([at(*place) for place in places]))[0]


def test_the_points_of_a_turned_map_find_their_cells_and_those_outside_are_counted():
    points = np.array([at(0, 1), at(3, 4), at(0, 1), at(0, 0) + 50.0])
    found, outside = cells_of(GRID, points)
    assert found.tolist() == [1, 19]
    assert outside == 1


def test_a_session_knows_what_it_was_told_last_and_only_what_differs_from_the_map():
    known = learn(GRID, LearnedMap(), 3, cells((0, 0), (1, 2)), occupied=True)
    known = learn(GRID, known, 3, cells((2, 2)), occupied=False)
    expected = WALL.copy()
    expected[0, 0], expected[2, 2] = True, False
    np.testing.assert_array_equal(applied(GRID, known).occupied, expected)
    assert len(known) == 2  # the wall at (1, 2) was known
    known = learn(GRID, known, 4, cells((0, 0)), occupied=False)
    known = learn(GRID, known, 4, cells((2, 2)), occupied=True)
    assert applied(GRID, known) == GRID
    assert len(known) == 0


def test_the_revision_grows_only_where_a_cell_changes():
    nothing = LearnedMap()
    first = revised(nothing, learn(GRID, nothing, 0, cells((0, 0)), occupied=True))
    again = revised(first, learn(GRID, first, 9, cells((0, 0)), occupied=True))
    other = revised(again, learn(GRID, again, 10, cells((0, 0)), occupied=False))
    assert [first.revision, again.revision, other.revision] == [1, 1, 2]
    assert again.step.tolist() == [9]  # it was seen anew
    assert len(forget(again, again.step < 9)) == 1
    assert len(forget(again, again.step < 10)) == 0


def test_what_is_learned_is_the_same_after_it_was_stored():
    known = learn(GRID, LearnedMap(revision=6), 700, cells((3, 0), (0, 1)), occupied=True, by=1)
    known = revised(LearnedMap(revision=6), learn(GRID, known, 701, cells((1, 2)), occupied=False))
    back = LearnedMap.from_bytes(known.to_bytes())
    for name in ("cell", "occupied", "by", "step"):
        np.testing.assert_array_equal(getattr(back, name), getattr(known, name))
    assert (back.revision, back.digest) == (7, known.digest)
    assert LearnedMap.from_bytes(LearnedMap().to_bytes()).revision == 0


@pytest.mark.parametrize("points", [[[0.0, 0.0, 0.0]], [[np.nan, 0.0]], [["a", 0]], np.zeros((2001, 2))])
def test_what_is_no_list_of_points_is_refused_with_its_name(points):
    with pytest.raises(SampleError) as refused:
        check_points(points, "occupied")
    assert refused.value.path == "occupied"


def test_the_clearance_near_new_cells_is_that_of_a_map_made_anew():
    random = np.random.default_rng(0)
    for _ in range(40):
        height, width = (int(side) for side in random.integers(3, 60, 2))
        grid = OccupancyGrid(random.random((height, width)) < 0.02, 0.05)
        corner, size = random.integers(0, (height, width)), random.integers(1, 8, 2)
        some = np.zeros((height, width), bool)
        some[corner[0] : corner[0] + size[0], corner[1] : corner[1] + size[1]] = True
        new = np.flatnonzero(some & (random.random((height, width)) < 0.6))
        known = learn(grid, LearnedMap(), 0, new, occupied=True)
        made = applied(grid, known)
        anew = OccupancyGrid(made.occupied, 0.05)
        np.testing.assert_array_equal(made.clearance, anew.clearance)
