"""The fields of a policy are made anew for the map that a session learns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from specshield.caution.taught import Taught
from specshield.episode import Config, decide, make_shield
from specshield.policy.planner.method import Settings
from specshield.policy.planner.policy import synthesise
from specshield.robot import STRETCH
from specshield.robot.dynamics import step
from specshield.service.heavy.tables import make
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.policy.planner.worlds import cells_of


def test_a_closed_door_is_driven_around_once_there_are_fields_for_the_learned_map():
    """A wall at x = 4 has two doors, 4.4 m apart. A goal lies 2 m away through the nearer one, which is shut
    by something. The policy's own fields still lead there. The other way takes some 65 of the 80 steps.
    """
    walls = np.zeros((60, 80), bool)
    walls[:, 39:41] = True
    walls[3:13, 39:41] = walls[47:57, 39:41] = False
    goal = {"Goal": {"type": "circle", "center": [5.0, 0.8], "radius": 0.4}}
    task = make_task(OccupancyGrid(walls, 0.1), STRETCH, "F[0,80] Goal", goal)
    shield = make_shield([synthesise(task)], Config(learn_map=False))
    poses, closed = [(3.0, 0.8, 0.0)], [(4.25, 0.1 * row + 0.05) for row in range(3, 13)]
    decision = decide(shield, poses, None, True)
    poses.append(step(shield.body, *poses[-1], int(STRETCH.motion_of[decision.action])))
    decision = decide(shield, poses, None, True, carry=decision.carry, occupied=closed)
    assert decision.reason == "infeasible"
    shield = replace(shield, proposers=make(shield, Taught.from_bytes(decision.carry.learned).map).proposers)
    while decision.spec_status == "pending":
        poses.append(step(shield.body, *poses[-1], int(STRETCH.motion_of[decision.action])))
        decision = decide(shield, poses, None, True, carry=decision.carry)
        assert decision.reason is None
    assert decision.spec_status == "satisfied"
    assert any(y > 4.7 for _, y, _ in poses)


def test_after_an_until_is_broken_its_left_side_keeps_no_way_back():
    """The place is five motions away, and five steps are left. Neither A nor B holds on the way."""
    places = {"A": (0, 0), "B": (2, 0)}
    for rule, status in (("F[0,8] B and (A or B) U[5,6] B", "violated"), ("F[0,8] B", "pending")):
        cells = cells_of(rule, places=places)
        shield = make_shield([synthesise(cells.task, Settings(pitch=0.2))])
        decision = decide(shield, [cells.pose(0, 2, 0)] * 4, np.zeros(5))
        assert (decision.spec_status, decision.reason) == (status, None)
        assert decision.distribution[1:4].tolist() == [0.0, 0.0, 0.0]
