"""Worlds that are not as told: runs that a session once lost."""

from evaluation.worlds import campaign
from evaluation.worlds.runs import Outcome, Trial, run


def test_a_robot_with_another_footprint_than_told_does_not_go_round_in_a_circle():
    """It turned away from what stopped it, back, and tried again, until no time was left."""
    outcome = run(Trial("case2", "collider", "scan"), 72)
    assert outcome.could
    assert outcome.kept


def test_a_robot_that_cannot_drive_backwards_does_not_get_stuck_where_walls_are_5_cm_off():
    """Without room beside its way it drove into a corner where it only just fits on the map."""
    outcome = run(Trial("case1", "shift", "contact", robot="trailing"), 5)
    assert outcome.could
    assert outcome.kept


def test_a_run_whose_line_was_cut_short_by_a_kill_is_made_again(tmp_path, monkeypatch):
    def made(trial, i):
        return Outcome(i, True, i != 1, 0.1, 2.0, [], {}, 0, 1.0, 1.0, [], [])

    monkeypatch.setattr(campaign, "run", made)
    trial = Trial("case1", "told", "none")
    campaign.outcomes(trial, 2, tmp_path, 1)
    (file,) = tmp_path.iterdir()
    whole = file.read_text()
    file.write_text(whole[:-9])
    assert campaign.outcomes(trial, 2, tmp_path, 1) == [made(trial, 0), made(trial, 1)]
    assert file.read_text() == whole
