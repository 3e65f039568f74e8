"""The joining rules, by hand and by property."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from specshield.errors import HistoryConflict, HistoryGap, PoseError
from specshield.service.sessions.history import join

TRAJECTORY = np.array([[0.2 * t, -0.1 * t, 0.5 * t] for t in range(8)])


def test_the_next_pose_alone_is_taken():
    assert np.array_equal(join(TRAJECTORY[:3], 3, TRAJECTORY[3:4]), TRAJECTORY[3:4])


def test_what_is_there_already_adds_nothing():
    assert join(TRAJECTORY[:4], 3, TRAJECTORY[2:4]).shape == (0, 3)
    assert join(TRAJECTORY[:4], 1, TRAJECTORY[:2]).shape == (0, 3)


def test_a_gap_names_the_first_missing_step():
    with pytest.raises(HistoryGap) as caught:
        join(TRAJECTORY[:3], 6, TRAJECTORY[4:7])
    assert caught.value.details["expected_t"] == 3


def test_too_many_poses():
    with pytest.raises(PoseError, match="poses cannot end at step"):
        join(TRAJECTORY[:3], 1, TRAJECTORY[:3])


@pytest.mark.parametrize("column", [0, 1, 2])
def test_tolerance_and_the_stored_value_wins(column):
    sent = TRAJECTORY[:4].copy()
    sent[1, column] += 0.9e-6
    assert np.array_equal(join(TRAJECTORY[:3], 3, sent), TRAJECTORY[3:4])
    sent[1, column] += 0.2e-6
    with pytest.raises(HistoryConflict) as caught:
        join(TRAJECTORY[:3], 3, sent)
    assert caught.value.path == "poses[1]"
    assert caught.value.details["t"] == 1


def test_headings_agree_modulo_a_turn():
    sent = TRAJECTORY[:3] + np.array([0, 0, 2 * math.pi])
    assert len(join(TRAJECTORY[:3], 2, sent)) == 0
    assert len(join(np.array([[0, 0, math.pi]]), 0, np.array([[0, 0, -math.pi + 5e-7]]))) == 0


@given(st.integers(1, 8), st.integers(0, 7), st.integers(1, 8))
def test_any_newest_part_either_joins_whole_or_is_refused(length, t, count):
    stored, first = TRAJECTORY[:length], t - count + 1
    if first < 0:
        return
    sent = TRAJECTORY[first : t + 1]
    if first > length:
        with pytest.raises(HistoryGap):
            join(stored, t, sent)
    else:
        joined = np.concatenate([stored, join(stored, t, sent)])
        assert np.array_equal(joined, TRAJECTORY[: max(length, t + 1)])
