"""Deadlines that come earlier, by hand."""

import numpy as np
import pytest

from specshield.policy.planner.earlier import earlier_rule
from specshield.stl import parse
from tests.policy.rooms import flat


@pytest.mark.parametrize(
    ("rule", "t", "sooner"),
    [
        ("F[0,40] West", 0, "F[0,36] West"),
        ("F[30,34] West", 0, "F[30,32] West"),  # half of the window is left
        ("F[0,10] West and F[0,40] West", 8, "F[0,10] West and F[0,36] West"),  # step 6 is over
        ("(not Hole) U[0,40] West", 0, "(not Hole) U[0,36] West"),
        ("G[20,30] West", 8, "G[16,30] West"),
        ("G[10,30] West", 8, "G[9,30] West"),
        ("G[20,30] not West", 8, "G[20,30] not West"),  # it holds already
        ("F[0,30] G[10,20] West", 0, "F[0,26] G[10,20] West"),
        ("G[0,30] (Hole -> F[0,12] West)", 0, "G[0,30] (Hole -> F[0,8] West)"),
        ("not F[0,40] Hole", 0, "G[1,40] not Hole"),  # which is the same after step 0
    ],
)
def test_deadlines_come_four_steps_earlier_where_they_can(rule, t, sooner):
    task = flat(rule)
    poses = np.tile((2.5, 1.0, 0.0), (t + 1, 1))  # in the east
    assert earlier_rule(task, task.formula, 4, poses, np.empty((t + 1, 0))) == parse(sooner)
