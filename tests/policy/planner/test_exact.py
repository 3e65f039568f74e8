"""Starts of an `until` near its deadline, which descending the fields comes too late for."""

import pytest

from benchmarks import deadlines
from specshield.policy.planner.policy import synthesise
from specshield.shield.episode import decide, make_shield, start


@pytest.mark.parametrize("number", [1, 9, 175])
def test_a_start_is_accepted_where_a_search_over_exact_poses_knows_a_way(number):
    """Of the last, the only way in time leads through a gap that the fields take to be shut."""
    task, pose, *_ = deadlines.the(number)
    shield = make_shield([synthesise(task)])
    start(shield, pose)
    decision = decide(shield, [pose], None, main_task_done=True)
    assert decision.spec_status == "pending"
    assert max(value for value in decision.robustness if value is not None) > 0.0
