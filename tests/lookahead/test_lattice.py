"""The lattice of two cells, and the windows of formulas, by hand."""

import numpy as np

from specshield.lookahead.lattice import _bits, _slots, blocked_at, is_blocked, pose_at
from tests.lookahead.by_hand import BACK, EAST, GO, STOP, WEST, make_world, place


def test_the_lattice_knows_where_poses_are_free_and_which_motions():
    _, _, planes = make_world("F[0,1] B and G[0,1] not B")
    west, east = place(planes, 0), place(planes, 1)
    assert np.flatnonzero(planes.valid[0]).tolist() == [west, east]
    assert pose_at(planes, 0, west) == WEST
    assert planes.free[:, 0, west].tolist() == [1.0, 0.0, 1.0]  # GO, BACK, STOP
    assert planes.free[:, 0, east].tolist() == [0.0, 1.0, 1.0]
    assert planes.row[[west, east]].tolist() == [0, 1]
    # Goal 0 is obligation 0, "B"; obligation 1 is "not B".
    assert planes.holds[0, [west, east]].tolist() == [0, 1]
    assert planes.keeps[0, [west, east]].tolist() == [0b10, 0b01]
    assert planes.open.tolist() == [1, 1, 0]
    assert planes.due.tolist() == [0b10, 0b10, 0]


def test_a_dwell_is_settled_by_where_it_begins():
    _, _, planes = make_world("F[1,4] G[2,3] B")
    assert (planes.first.tolist(), planes.last.tolist()) == ([3], [6])


def test_the_bits_of_windows():
    bits = _bits(np.array([0, 2]), np.array([1, 3]), np.array([0, 4]), 3)
    assert bits.tolist() == [1, 1, 16, 16, 0]


def test_the_sets_of_settled_goals_that_can_be_had():
    """Goal 0 in steps 0 to 1, goal 1 in steps 1 to 2: a set needs its goals begun and the others not over."""
    slot = _slots(np.array([0, 1]), np.array([1, 2]), 2, 1)
    assert (slot[:4] >= 0).tolist() == [
        [True, True, False, False],
        [False, True, False, True],  # goal 0 has to be settled after step 0's successor: at 1 at the latest
        [False, False, False, True],
        [False, False, False, False],
    ]
    assert sorted(slot[slot >= 0].tolist()) == list(range(5))


def test_steps_that_share_a_number():
    """Steps 2 and 3 share one, and 4 and 5; the first step of a set has its own, and so has what is left."""
    slot = _slots(np.array([0]), np.array([5]), 5, 2)
    assert slot[:6].T.tolist() == [[0, 2, 4, 4, 6, -1], [1, 3, 5, 5, 7, 7]]


def test_a_motion_is_blocked_where_it_goes_less_than_half_its_way():
    body, _, _ = make_world("F[0,1] B")
    assert not is_blocked(body, GO, WEST, EAST)
    assert is_blocked(body, GO, WEST, (0.19, 0.1, 0.0))
    assert not is_blocked(body, BACK, EAST, (0.19, 0.1, 0.0))
    assert not is_blocked(body, STOP, WEST, WEST)
    assert blocked_at(body, *WEST).tolist() == [False, True, False]  # GO, BACK, STOP
