"""The count of the code's lines."""

from benchmarks import lines

SHIELD = lines.PACKAGE / "shield"


def test_a_folder_holds_what_lies_in_it_and_below():
    counted = {SHIELD / "answer.py": 200, SHIELD / "deep" / "er.py": 30, lines.PACKAGE / "shields.py": 5}
    assert lines.below(counted, SHIELD) == 230
    assert lines.below(counted, lines.PACKAGE / "shields.py") == 5


def test_bounds_that_hold_are_not_mentioned():
    assert list(lines.breaches({SHIELD / "answer.py": lines.LONGEST}, lines.MOST_TRUSTED)) == []


def test_a_bound_that_is_broken_is_named_with_its_figure():
    (trusted,) = lines.breaches({}, lines.MOST_TRUSTED + 1)
    most = lines.MOST_TRUSTED
    assert trusted == f"the trusted core has {most + 1:,} lines; expected at most {most:,}"
    whole, module = lines.breaches({SHIELD / "answer.py": lines.MOST + 1}, 0)
    assert whole == f"app/ has {lines.MOST + 1:,} lines; expected at most {lines.MOST:,}"
    assert module == f"app/specshield/shield/answer.py has {lines.MOST + 1} lines; expected at most 350"
