"""Every entry of an observation by hand, in the corridor."""

from __future__ import annotations

import math

import numpy as np
import pytest

from specshield.policy.dqn.environment import free_poses
from specshield.policy.dqn.observation import PER_MOTION, arrive, observation_size, observe, outcome
from specshield.policy.dqn.scene import make_scene
from specshield.policy.progress import BROKEN, PENDING, SETTLED
from specshield.robot import STRETCH
from specshield.robot.dynamics import successors
from tests.policy.rooms import CUSTOM, corridor, flat, in_state

HALF = math.sqrt(0.5)
FORMULA = "F[2,20] End and G[0,20] y < 0.9"


def seen(formula, pose, t, **progress):
    scene = make_scene(corridor(formula))
    state = in_state(scene, pose, **progress)
    observe(scene, t, state)
    return state.observation


def test_every_entry_by_hand():
    ahead = seen(FORMULA, (1.25, 0.75, 0.0), 5)
    time_and_pose = [5 / 20, 1.0, 0.0, (1.25 - 2.5) / 2.5, 0.0]
    # The field falls by 0.2 m over 0.2 m to the east. The row to the north is closed: 1 m more, 0.5 m away.
    way = [HALF, -HALF]  # to the south-east: ahead and to the right
    spare = (15 * 0.5 - 3.0) / 5.0  # 15 steps of 0.5 m are left for 3 m
    goal = [0.0, 0.0, 15 / 50, -1.0, 3.0 / 5.0, 3.0 / 3.5, *way, spare, 0.0]
    always = [0.15 / 0.3, 1.0]
    motions = [1.0, 0.0, 0.5, 1.0, 1.0, 0.5, 1.0, 0.0, 0.5, 1.0, 0.0, 0.5]  # wait, go, left, right
    np.testing.assert_allclose(ahead, time_and_pose + goal + always + motions, atol=1e-6)

    north = seen(FORMULA, (1.25, 0.75, math.pi / 2), 5)
    np.testing.assert_allclose(north[1:3], [0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(north[11:13], [-HALF, -HALF], atol=1e-6)  # behind and to the right
    # To go brings it 1 m farther, two strides, and over the line: 0.9 - 1.25 is less than -0.3.
    np.testing.assert_allclose(north[20:23], [1.0, -1.5, -1.0], atol=1e-6)


def test_what_contact_holds_back_is_not_made_in_full():
    stuck = seen(FORMULA, (4.75, 0.75, 0.0), 5)
    assert stuck[20:23].tolist() == [0.0, 0.0, 0.5]
    assert stuck[9:11].tolist() == [0.0, 0.0]  # no distance is left


def test_times_count_down_and_are_clipped():
    early, late = seen(FORMULA, (1.25, 0.75, 0.0), 0), seen(FORMULA, (1.25, 0.75, 0.0), 20)
    np.testing.assert_allclose(early[6:8], [2 / 50, 20 / 50])
    np.testing.assert_allclose(late[6:8], [0.0, 0.0])
    assert late[13] == np.float32(-3.0 / 5.0)  # no steps are left for 3 m
    far = seen("F[150,200] End", (1.25, 0.75, 0.0), 0)
    assert far[6:8].tolist() == [2.0, 2.0]


def test_progress_is_seen():
    hold = "F[0,10] G[2,4] End and F[0,9] x > 1"
    first = seen(hold, (4.25, 0.75, 0.0), 3, status=[PENDING, SETTLED], run=[1, 0])
    assert first[5] == 0.0
    np.testing.assert_allclose(first[6:8], [0.0, (14 - 3) / 50])  # the dwell may begin at 2, and ends by 14
    assert first[14] == np.float32(1 / 3)  # one step of the three
    assert first[15] == 1.0


def test_an_always_that_does_not_hold_yet_makes_no_motion_unsafe():
    pose = (1.25, 0.75, math.pi / 2)
    assert seen("F[0,20] End and G[7,20] y < 0.9", pose, 5)[22] == 1.0
    assert seen("F[0,20] End and G[7,20] y < 0.9", pose, 6)[22] == -1.0  # it holds at the next step


def test_what_is_left_as_it_was_is_what_would_be_written_anew():
    """Along drawn ways on which the robot often stands or turns, and windows begin and end meanwhile."""
    formula = "F[3,9] End and F[0,30] G[0,2] x < 1 and G[6,14] x < 1.4 and G[0,30] y > 0"
    scene = make_scene(corridor(formula))
    for seed in range(10):
        way, random = in_state(scene, (1.25, 0.75, 0.0)), np.random.default_rng(seed)
        for t in range(1, 30):
            observe(scene, t - 1, way)
            fresh = in_state(scene, way.pose.tolist(), status=way.status, run=way.run)
            observe(scene, t - 1, fresh)
            assert way.observation.tolist() == fresh.observation.tolist(), (seed, t)
            moved = arrive(scene.rules, t, *way.nexts[random.choice([0, 0, 0, 1, 2, 3])], way)
            assert moved == (way.pose.tolist() != fresh.pose.tolist())
            successors(scene.body, way.pose, way.nexts)


def test_arriving_takes_a_state_into_the_progress():
    scene = make_scene(corridor(FORMULA))
    state = in_state(scene, (3.75, 0.75, 0.0))
    assert outcome(state.status) == PENDING
    arrive(scene.rules, 3, 4.25, 0.75, 0.0, state)
    assert state.status.tolist() == [SETTLED, PENDING]
    assert outcome(state.status) == PENDING
    arrive(scene.rules, 4, 4.25, 1.0, 0.0, state)
    assert state.status.tolist() == [SETTLED, BROKEN]
    assert outcome(state.status) == BROKEN
    assert outcome(np.array([SETTLED, SETTLED], np.int8)) == SETTLED


@pytest.mark.parametrize("robot", [STRETCH, CUSTOM], ids=["stretch", "custom"])
def test_what_is_seen_of_one_motion_does_not_depend_on_the_others(robot):
    """Motions share work where they can: each alone, in the same states, looks the same bit for bit."""
    task = flat("F[0,30] West and G[0,40] not Hole and G[5,40] theta < 3", robot=robot)
    scene = make_scene(task)
    body, motions = scene.body, len(robot.motions)

    def all_seen(part, t, pose):
        state = in_state(scene._replace(body=part), pose)
        observe(scene._replace(body=part), t, state)
        return state.observation

    common = observation_size(scene.rules, body) - PER_MOTION * motions
    for t, pose in enumerate(free_poses(task, body, 40, np.random.default_rng(3))):
        together = all_seen(body, t, pose)
        assert together.min() < 0.0
        for m in range(motions):
            part = body._replace(translate=body.translate[m : m + 1], rotate=body.rotate[m : m + 1])
            at = common + PER_MOTION * m
            own = np.r_[:common, at : at + PER_MOTION]
            assert (all_seen(part, t, pose) == together[own]).all()
