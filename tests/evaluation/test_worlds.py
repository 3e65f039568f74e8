"""Worlds that are not as told: a run that a session once lost."""

from evaluation.worlds.runs import Trial, run


def test_a_robot_with_another_footprint_than_told_does_not_go_round_in_a_circle():
    """It turned away from what stopped it, back, and tried again, until no time was left."""
    outcome = run(Trial("case2", "collider", "scan"), 72)
    assert outcome.could
    assert outcome.kept
