"""Due dates worked out by hand. The steps to come are unknown but for what a test supposes."""

import pytest

from specshield.policy.planner.due_dates import NO_DATE, due_date, is_open, needed_until, stay_for
from tests.policy.planner.worlds import bounds_after, cells_of, literal_of

NESTED = "F[0,5] (A and F[1,3] B) and G[2,4] not C"


def due(cells, inside, name, side=1, held=(), guess=NO_DATE):
    packed, bounds, s = bounds_after(cells, inside, held)
    return due_date(packed, literal_of(cells, name, side), s, guess, bounds)


NO, YES = False, True


@pytest.mark.parametrize(
    ("past", "expected"),
    [
        # Nothing has been seen: A at 5 and B at 8 would do; at step 2 the robot has to be out of C.
        ({"A": [], "B": [], "C": []}, {"A": 5, "B": 8, "not C": 2}),
        # In A at step 1: B within three steps would do, and so would A and B again.
        ({"A": [NO, YES], "B": [NO, NO], "C": [NO, NO]}, {"A": NO_DATE, "B": 8, "not C": 2}),
        # No B within those three steps: A is due again.
        ({"A": [NO, YES, NO, NO, NO], "B": [NO] * 5, "C": [NO] * 5}, {"A": 5, "B": 8, "not C": NO_DATE}),
        # In A for the last time at step 5: B is due at 8, and only that.
        ({"A": [NO] * 5 + [YES], "B": [NO] * 6, "C": [NO] * 6}, {"A": NO_DATE, "B": 8}),
        # B came two steps after A: nothing is due any more.
        ({"A": [YES, NO, NO], "B": [NO, NO, YES], "C": [NO] * 3}, {"A": NO_DATE, "B": NO_DATE, "not C": 3}),
    ],
)
def test_due_dates_of_a_nested_formula(past, expected):
    cells = cells_of(NESTED)
    for literal, step in expected.items():
        name, side = literal.removeprefix("not "), -1 if literal.startswith("not ") else 1
        for guess in (NO_DATE, 0, step, 7):  # a guess saves time and changes nothing
            assert due(cells, past, name, side, guess=guess) == step, literal


@pytest.mark.parametrize(("event", "expected"), [(1.0, 3), (0.0, NO_DATE)])
def test_a_reaction_is_due_where_the_signal_as_it_is_held_asks_for_it(event, expected):
    cells = cells_of("G[0,4] (event > 0.5 -> F[0,3] A)", {"event": event})
    assert due(cells, {"A": []}, "A", held=[event - 0.5, 0.0]) == expected


def test_whether_anything_can_still_save_the_formula():
    cells = cells_of("F[0,2] A and G[0,3] not C")
    for past, expected in (
        ({"A": [NO, NO], "C": [NO, NO]}, True),
        ({"A": [NO, NO, NO], "C": [NO] * 3}, False),
        ({"A": [YES, NO], "C": [NO, YES]}, False),
    ):
        packed, bounds, _ = bounds_after(cells, past)
        assert is_open(packed, bounds) == expected


def test_until_when_an_always_needs_its_literal():
    cells = cells_of("G[2,4] not C and F[0,6] A")
    packed, bounds, s = bounds_after(cells, {"A": [NO], "C": [NO]})
    k = literal_of(cells, "C", -1)
    assert needed_until(packed, k, s, 2, NO_DATE, -1, bounds) == 4
    assert needed_until(packed, k, s, 5, NO_DATE, -1, bounds) == 4  # at no step from 5 on
    assert needed_until(packed, literal_of(cells, "A", 1), s, 1, NO_DATE, -1, bounds) == 0  # at no one step


def test_the_left_side_of_an_until_is_needed_as_long_as_the_right_one_has_not_held():
    cells = cells_of("not B U[0,6] A")
    packed, bounds, s = bounds_after(cells, {"A": [NO], "B": [NO]})
    k, goal = literal_of(cells, "B", -1), literal_of(cells, "A", 1)
    assert needed_until(packed, k, s, s + 1, 6, goal, bounds) == 5
    assert needed_until(packed, k, s, s + 1, 4, goal, bounds) == 3  # only steps before 4 are asked about
    packed, bounds, s = bounds_after(cells, {"A": [NO, YES], "B": [NO, NO]})
    assert needed_until(packed, k, s, s + 1, 6, goal, bounds) == s


def test_how_long_to_stay():
    cells = cells_of("F[0,6] G[0,2] A")
    k = literal_of(cells, "A", 1)
    packed, bounds, s = bounds_after(cells, {"A": [NO, YES]})
    assert due_date(packed, k, s, NO_DATE, bounds) == 6  # a dwell from 6 to 8 is the last that will do
    assert stay_for(packed, k, s, 6, 7, bounds) == 2  # steps 2 and 3, after 1
    assert stay_for(packed, k, s, 6, 1, bounds) == 2  # one more than the steps there are
    packed, bounds, s = bounds_after(cells, {"A": [NO, YES, YES, YES]})
    assert due_date(packed, k, s, NO_DATE, bounds) == NO_DATE
