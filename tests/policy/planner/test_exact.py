"""What descending the fields does not find: starts near a deadline, and narrow places."""

import numpy as np
import pytest

from benchmarks import deadlines
from specshield.policy.planner.policy import synthesise
from specshield.robot import STRETCH
from specshield.robot.dynamics import make_body, simulate
from specshield.shield.episode import decide, make_shield, start
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid

ROOM = OccupancyGrid(np.pad(np.zeros((48, 48), bool), 1, constant_values=True), 0.1)


@pytest.mark.parametrize("number", [1, 9, 175])
def test_a_start_is_accepted_where_a_search_over_exact_poses_knows_a_way(number):
    """Of the last, the only way in time leads through a gap that the fields take to be shut."""
    task, pose, *_ = deadlines.the(number)
    shield = make_shield([synthesise(task)])
    start(shield, pose)
    decision = decide(shield, [pose], None, main_task_done=True)
    assert decision.spec_status == "pending"
    assert max(value for value in decision.robustness if value is not None) > 0.0


@pytest.mark.parametrize("heading", [False, True])
def test_a_place_much_smaller_than_a_cell_is_found_and_kept_to(heading):
    """The disc lies where some motions lead, between the crossings; the window is 2 degrees wide."""
    begin, after = np.array([2.0, 2.0, 0.3]), np.empty((9, 3))
    simulate(make_body(STRETCH, ROOM), begin, np.array([1, 5, 0, 0, 0, 0, 2, 0, 0]), after)
    x, y, theta = after[-1].tolist()
    rule = f"F[0,60] (Dock and abs(theta - {theta:.6f}) < 0.0175)" if heading else "F[0,60] Dock"
    dock = {"Dock": {"type": "circle", "center": [x, y], "radius": 0.02}}
    shield = make_shield([synthesise(make_task(ROOM, STRETCH, rule, dock))])
    start(shield, begin)
    poses, carry, random = [begin], None, np.random.default_rng(3)
    for _ in range(60):
        logits = np.where(STRETCH.terminal, -np.inf, random.normal(0.0, 3.0, len(STRETCH.actions)))
        decision = decide(shield, poses, logits, carry=carry)
        poses.append(decision.next_poses[decision.action])
        carry = decision.carry
    off = np.abs(np.array(poses) - after[-1])
    assert np.any((np.hypot(off[:, 0], off[:, 1]) < 0.02) & (off[:, 2] < (0.0175 if heading else 10.0)))
