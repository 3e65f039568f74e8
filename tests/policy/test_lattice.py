"""The lattice: its poses and headings, where motions lead, what a table says between its crossings."""

from __future__ import annotations

import math

import numpy as np
import pytest

from specshield.policy.lattice import (
    INVALID,
    NO_TIME,
    STEP_CODES,
    Corners,
    bilinear,
    coordinates,
    corner,
    find_corners,
    heading_count,
    leads_back,
    make_lattice,
    pose_of,
)
from specshield.policy.planner.fields import OUT_OF_REACH, UNREACHED, Fields, to_go, to_go_after
from specshield.policy.reachability.tables import HOPELESS, latest_at
from specshield.robot import STRETCH
from specshield.robot.dynamics import make_body
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.cells import CELL, FORWARD, LEFT, RIGHT, ROBOT, WAIT

CORRIDOR = OccupancyGrid(np.array([[0, 0, 0, 1]], bool), CELL)
TURNED = OccupancyGrid(np.zeros((10, 20), bool), 0.1, (1.0, -2.0, 0.7))
MOVES = ((0.2, 0.0), (0.0, math.radians(30)), (0.0, math.radians(-30)))  # of a Stretch: ahead, left, right


def test_the_fewest_headings_that_every_turn_fits():
    assert heading_count([]) == 4
    assert heading_count([math.pi / 2, -math.pi / 2]) == 4
    assert heading_count([math.radians(30), math.radians(-6)]) == 60
    assert heading_count([0.5236]) == 12  # 30 degrees, as people write them
    assert heading_count([0.5]) == 25  # none fits; 2 of these are 0.5027
    assert heading_count([0.1, 0.17, 0.23, 0.37]) == 72  # none is near


def test_a_pose_and_its_coordinates():
    body = make_body(STRETCH, TURNED)
    x, y, theta = pose_of(body, 0.1, 60, 3, 5, 45)
    u, v = 0.55, 0.35  # the centre of column 5 and row 3, along the turned grid
    assert x == pytest.approx(1.0 + u * math.cos(0.7) - v * math.sin(0.7))
    assert y == pytest.approx(-2.0 + u * math.sin(0.7) + v * math.cos(0.7))
    assert theta == pytest.approx(-math.pi / 2)
    assert coordinates(body, 0.1, 60, x, y, theta) == pytest.approx((3.0, 5.0, 45.0))


def test_where_the_motions_lead_in_a_corridor():
    """Three free cells in a row, then a wall: east leads on, from the last cell nowhere, north nowhere."""
    lattice = make_lattice(make_body(ROBOT, CORRIDOR), CELL)
    assert lattice.valid[0, :, 0].tolist() == [1, 1, 1, 0]
    np.testing.assert_allclose(lattice.far_u[0, :3, 0, 0], [1.0, 2.0, -1.0])  # east
    np.testing.assert_allclose(lattice.far_u[0, :3, 2, 0], [-1.0, 0.0, 1.0], atol=1e-9)  # west
    np.testing.assert_allclose(lattice.far_u[0, :3, 1, 0], [-1.0, -1.0, -1.0])  # north
    assert lattice.far_h[0, 0, 0, 0] == 0
    assert lattice.far_h[0, 1, 2, 0] == 2
    assert lattice.shift.tolist() == [1, -1]
    assert lattice.turns[0, :3].all()
    assert lattice.reach == 2


def test_the_corners_about_a_place():
    found = [corner(2.25, 4.5, n) for n in range(4)]
    assert found == [(2, 4, 0.375), (2, 5, 0.375), (3, 4, 0.125), (3, 5, 0.125)]
    assert [corner(2.0, 4.0, n)[2] for n in range(4)] == [1.0, 0.0, 0.0, 0.0]


CELLS = np.array([[0, 1], [2, -1]], np.int32)  # the fourth cell has no row
CODES = np.array([[1, 65], [129, 193], [257, INVALID]], np.uint16)  # of two headings


def steps_at(v, u, h):
    """As the tables and the planner's fields have it, whose codes begin at 1 and at 0."""
    corners = Corners(np.empty(4, np.int64), np.empty(4))
    found = latest_at(CODES, corners, find_corners(CELLS, v, u, corners), h)
    found = np.inf if found == HOPELESS else found
    codes = np.where(CODES == INVALID, INVALID, CODES - 1).astype(np.uint16)
    assert to_go(Fields(CELLS, codes[None], 1.0), 0, v, u, h) == found
    return found


def test_a_table_between_its_crossings():
    assert steps_at(0.0, 0.0, 0.0) == 0.0
    assert steps_at(0.0, 0.0, 1.0) == 1.0
    assert steps_at(0.0, 0.0, 0.25) == 0.25
    assert steps_at(0.0, 0.0, 1.75) == 0.25  # between the last heading and the first
    assert steps_at(0.0, 0.5, 0.0) == 1.0  # between 0 and 128 codes
    assert steps_at(0.5, 0.0, 1.0) == 1.0  # one of the two corners is invalid: the other alone
    assert steps_at(0.5, 0.5, 0.0) == pytest.approx((0.0 + 2.0 + 4.0) / 3.0)  # the corner without a row
    assert steps_at(1.0, 1.0, 0.0) == np.inf  # no valid corner
    assert steps_at(-2.0, 0.0, 0.0) == np.inf  # outside
    assert steps_at(-0.5, 0.0, 1.0) == 1.0  # at the edge: the row that there is


def test_what_no_way_leads_from_is_as_far_as_can_be_told():
    fields = Fields(CELLS, np.full((1, 3, 2), UNREACHED, np.uint16), 1.0)
    assert to_go(fields, 0, 0.0, 0.0, 0.0) == OUT_OF_REACH


def test_a_full_table_at_one_heading():
    valid = np.array([[[1], [1]], [[1], [0]]], np.uint8)
    table = np.array([[[2.0], [4.0]], [[6.0], [90.0]]], np.float32)
    assert bilinear(valid, table, 0.0, 1.0, 0) == 4.0
    assert bilinear(valid, table, 0.25, 0.0, 0) == 3.0
    assert bilinear(valid, table, 0.5, 0.5, 0) == 4.0  # the three that are valid
    assert bilinear(valid, table, 1.0, 1.0, 0) == NO_TIME


def test_a_motion_from_a_place_between_the_crossings():
    """Steps to go that rise by 10 along the rows, by 1 along the columns, or by 1 from heading to heading."""
    body, out = make_body(STRETCH, TURNED), np.empty(len(STRETCH.motions))
    cell = np.arange(200, dtype=np.int32).reshape(10, 20)
    code = np.empty((2, 200, 60), np.uint16)
    code[0], code[1] = STEP_CODES * (10 * (cell // 20) + cell % 20).reshape(-1, 1), STEP_CODES * np.arange(60)
    fields, (ahead, left, right) = Fields(cell, code, 0.1), map(STRETCH.motions.index, MOVES)
    x, y, _ = pose_of(body, 0.1, 60, 3, 5, 0)
    theta = 0.7 + math.pi / 6  # 30 degrees from the columns: 0.2 m lead on by 1 row and 1.73 columns
    to_go_after(body, fields, 0, x, y, theta, -1, out)
    assert out[ahead] == pytest.approx(40.0 + 5.0 + 2.0 * math.cos(math.pi / 6))
    assert out[left] == pytest.approx(35.0)
    to_go_after(body, fields, 1, x, y, theta, -1, out)
    h = theta * 60 / (2 * math.pi)
    assert out[[ahead, left, right]] == pytest.approx([h, h + 5.0, h - 5.0])
    to_go_after(body, fields, 1, x, y, math.radians(12), -1, out)
    assert out[right] == pytest.approx(57.0)  # heading 2, and 5 of 60 back


def test_what_leads_straight_back():
    body = make_body(ROBOT, CORRIDOR)
    assert leads_back(body, LEFT, RIGHT)
    assert not leads_back(body, LEFT, LEFT)
    assert not leads_back(body, FORWARD, LEFT)
    assert not leads_back(body, WAIT, RIGHT)
    assert not leads_back(body, -1, RIGHT)
