"""Room beside its way for a robot that cannot drive backwards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from specshield.caution.room import ROOM, has_room, widened
from specshield.robot import STRETCH, Action
from specshield.robot.dynamics import make_body, simulate
from specshield.world.occupancy import OccupancyGrid

ON, LEFT, WAIT = range(3)
ACTIONS = (Action("on", 0.2), Action("left", rotate=np.pi / 2), Action("wait"), Action("end", terminal=True))
FORWARD = replace(STRETCH, radius=0.2, offset=(0.0, 0.0), on_contact="stay", actions=ACTIONS)
BODY = make_body(FORWARD, OccupancyGrid(np.zeros((20, 40), bool), 0.05))  # a room of 2 x 1 m


def room_of(pose, *motions):
    poses = np.empty((len(motions), 3))
    simulate(BODY, np.array(pose), np.array(motions), poses)
    return has_room(widened(BODY), np.array(pose), np.array([motions]), poses[None]).tolist()


def test_a_future_has_room_where_nothing_is_nearer_than_that_all_along_it():
    near = 0.2 + ROOM
    assert room_of((1.0, 0.5, 0.0), ON, ON) == [True]
    assert room_of((2.0 - near - 0.2 - 0.001, 0.5, 0.0), ON, WAIT) == [True]
    assert room_of((2.0 - near - 0.2 + 0.001, 0.5, 0.0), ON, WAIT) == [False]
    assert room_of((2.0 - near - 0.2 + 0.001, 0.5, 0.0), WAIT, LEFT) == [True]


def test_what_is_near_at_the_start_may_stay_as_near_and_come_no_nearer():
    low = 0.2 + 0.5 * ROOM
    assert room_of((1.0, low, 0.0), ON, ON) == [True]  # along the wall
    assert room_of((1.0, low, np.pi / 2), ON, LEFT) == [True]  # away from it
    assert room_of((1.0, low + 0.02, -np.pi / 4), WAIT, ON) == [True]  # f has it stay, larger or not
    assert room_of((1.0, low + 0.16, -np.pi / 4), WAIT, ON) == [False]  # nearer
