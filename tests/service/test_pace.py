"""Where a decision is made: on the event loop, on it with the processor's time measured, or in a thread."""

import pytest

from specshield.service.sessions.steps import LONG, SEVERAL, SHORT, WATCHED, Pace


@pytest.fixture
def known():
    """The pace of a policy whose first decisions, made in threads, were short."""
    pace = Pace()
    for _ in range(SEVERAL):
        assert not pace.short
        pace.add(0.0001, 0.0001)
    assert pace.short
    assert not pace.doubted
    return pace


def test_a_late_decision_alone_changes_nothing(known):
    known.add(10 * SHORT, None)
    assert known.short
    assert not known.doubted
    for _ in range(SEVERAL):
        known.add(0.0001, None)
    known.add(10 * SHORT, None)
    assert known.short
    assert not known.doubted


def test_a_busy_machine_does_not_send_short_decisions_to_threads(known):
    for _ in range(3):
        known.add(10 * SHORT, None)
        known.add(10 * SHORT, None)
        for _ in range(SEVERAL):
            assert known.short
            assert known.doubted
            known.add(10 * SHORT, 0.0001)  # late by the clock, short by the processor
        assert known.short
        assert not known.doubted


def test_decisions_that_compute_long_are_made_in_threads(known):
    known.add(2 * SHORT, None)
    known.add(2 * SHORT, None)
    known.add(2 * SHORT, 2 * SHORT)
    for _ in range(WATCHED):
        assert not known.short
        known.add(0.0001, 0.0001)
    assert known.short
    assert not known.long


def test_after_several_that_take_very_long_another_process_decides(known):
    for _ in range(SEVERAL - 1):
        known.add(2 * LONG, 2 * LONG)
    assert not known.long
    known.add(2 * LONG, 2 * LONG)
    assert known.long
