import math

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from specshield.robot import STRETCH
from specshield.robot.dynamics import make_body
from specshield.sim.robot import SimulatedRobot
from specshield.sim.senses import RAYS, REACH, SIGHT, scan, see
from specshield.world.occupancy import OccupancyGrid


def body(origin=(0.0, 0.0, 0.0)):
    """A room of 8 m by 4 m with a pillar, half a metre wide, from (5, 2) on."""
    occupied = np.zeros((80, 160), bool)
    occupied[40:50, 100:110] = True
    return make_body(STRETCH, OccupancyGrid(occupied, 0.05, origin))


def ranges(world, pose):
    out = np.empty(RAYS)
    scan(world, *pose, out)
    return out


def test_ranges_are_distances_to_the_first_obstacle_counter_clockwise_from_ahead():
    seen = ranges(body(), (3.0, 2.2, 0.0))
    assert seen[0] == pytest.approx(2.0)  # the pillar
    assert seen[RAYS // 4] == pytest.approx(1.8)  # the wall to the left
    assert seen[RAYS // 2] == pytest.approx(3.0)
    assert seen[3 * RAYS // 4] == pytest.approx(2.2)
    assert ranges(body(), (1.0, 1.0, 0.0))[0] == REACH
    assert ranges(body(), (3.0, 2.2, math.pi / 2))[3 * RAYS // 4] == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("target", "theta", "expected"),
    [
        ((4.0, 3.0), 0.0, (math.hypot(1.0, 0.8), math.atan2(0.8, 1.0))),
        ((4.0, 2.2), math.radians(50), (1.0, -math.radians(50))),
        ((4.0, 2.2), math.radians(70), None),  # beside the field of view
        ((2.0, 2.2), 0.0, None),  # behind
        ((6.0, 2.2), 0.0, None),  # behind the pillar
        ((3.0 + SIGHT + 0.1, 1.5), 0.0, None),  # too far
    ],
)
def test_the_target_is_seen_near_ahead_and_in_the_open(target, theta, expected):
    seen, distance, bearing = see(body(), 3.0, 2.2, theta, *target)
    assert seen == (expected is not None)
    assert (distance, bearing) == pytest.approx(expected or (0.0, 0.0))


@settings(max_examples=50)
@given(
    st.floats(0.3, 7.7), st.floats(0.3, 3.7), st.floats(-3.1, 3.1),
    st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(-3.1, 3.1),
)  # fmt: skip
@example(x=5.0, y=1.9, theta=0.0, dx=8.0, dy=0.0, turn=1.5)
def test_senses_are_egocentric(x, y, theta, dx, dy, turn):
    """Moving the map, the target and the robot together changes nothing."""
    assume(not (4.99 < x < 5.51 and 1.99 < y < 2.51))  # at its edge, rounding puts it in or out
    c, s = math.cos(turn), math.sin(turn)

    def moved(px, py):
        return dx + c * px - s * py, dy + s * px + c * py

    here, there = body(), body((dx, dy, turn))
    # A ray that grazes a corner may pass on the other side of it: all but a few have to agree.
    apart = np.abs(ranges(here, (x, y, theta)) - ranges(there, (*moved(x, y), theta + turn)))
    assert (apart < 1e-6).sum() >= RAYS - 2
    target = (4.6, 3.1)
    one = see(here, x, y, theta, *target)
    other = see(there, *moved(x, y), theta + turn, *moved(*target))
    if one[0] == other[0]:  # likewise
        assert one[1:] == pytest.approx(other[1:], abs=1e-6)


def test_the_robot_senses_its_case_and_what_it_did(case):
    x, y = case.target
    robot = SimulatedRobot(case, (x - 0.5, y, 0.0))
    senses = robot.sense()
    assert (senses.seen, senses.distance, senses.bearing) == (
        True,
        pytest.approx(0.5),
        pytest.approx(0.0, abs=1e-9),
    )
    assert senses.last_action is None
    assert senses.ranges.min() > 0.0
    robot.execute(1)
    senses = robot.sense()
    assert senses.last_action == 1
    assert senses.bearing == pytest.approx(math.radians(30))
