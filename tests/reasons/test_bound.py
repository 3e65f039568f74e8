"""What is called impossible is impossible: held against every future of a robot on whole cells."""

import math

import numpy as np
import pytest

from specshield.reasons.bound import proof
from specshield.robot import STRETCH
from specshield.robot.dynamics import make_body
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.reasons.random_rules import cells_of, draw, history


def test_nothing_is_proved_where_some_future_keeps_the_rule():
    random, proved, impossible = np.random.default_rng(11), 0, 0
    for _ in range(400):
        rule = draw(random, depth=int(random.integers(1, 4)))
        if rule.horizon == 0:
            continue
        cells = cells_of(rule)
        past = history(cells, random, int(random.integers(0, rule.horizon)))
        why = proof(cells.task, cells.body, past, {})
        exists = bool(cells.feasible(past).any())
        assert why is None or not exists, f"{rule.text} from {past.tolist()}: {why}"
        proved, impossible = proved + (why is not None), impossible + (not exists)
    assert impossible > 100
    assert proved > 0.8 * impossible, (proved, impossible)


def hall(formula, regions, wall=False, **more):
    """A hall of 10 x 2 m for a Stretch, with a wall across its middle or without."""
    occupied = np.zeros((40, 200), bool)
    occupied[:, 100] = wall
    return make_task(OccupancyGrid(occupied, 0.05), STRETCH, formula, regions, **more)


def circle(x, radius=0.3):
    return {"type": "circle", "center": [x, 1.0], "radius": radius}


@pytest.mark.parametrize(
    ("formula", "wall", "said"),
    [
        ("F[0,15] Far", False, "before step 18, and 'F[0,15] Far' needs it by step 15"),
        ("F[0,2] Soon", False, "before step 3, and 'F[0,2] Soon' needs it by step 2"),
        ("F[0,2] Soon and G[1,60] not Far", False, "'Soon' cannot be met from here before step 3"),
        (
            "F[0,1] Soon and G[1,60] not Far",
            False,
            "whatever the robot does, it breaks F[0,1] Soon by step 1",
        ),
        ("F[0,400] Far", True, "no way leads to where F[0,400] Far can be met"),
        (
            "F[0,400] Far and G[0,400] not Strip",
            False,
            "no way leads to where F[0,400] Far can be met while 'G[0,400] not Strip' is kept",
        ),
        ("F[2,9] Near and G[2,9] not Near", False, "asks for 'Near and not Near', which holds nowhere"),
        ("F[0,9] (Near and Far)", False, "asks for 'Near and Far', which holds nowhere"),
        ("F[0,60] x > 11", False, "asks for 'x > 11', which holds nowhere"),
        ("F[0,9] Near and F[10,20] Far", False, None),
        ("F[22,22] Far and F[24,30] Near", False, "not all of these can be reached in time"),
        ("F[2,2] theta > 2", False, "whatever the robot does, it breaks F[2,2] theta > 2 by step 2"),
        ("F[0,0] Far", False, "Far is broken already"),
        ("G[2,9] theta > 2", False, "whatever the robot does, it breaks G[2,9] theta > 2 by step 2"),
        ("G[0,20] F[0,4] Far", False, "'Far' cannot be met from here before step 18"),
        ("F[0,10] Far or F[0,15] Far", False, "and its 1 other ways are ruled out likewise"),
        ("not Near U[0,12] Far", False, "before step 18 while 'not Near' is kept, and the rule"),
        ("not Strip U[0,400] Far", False, "no way leads to where F[0,400] Far can be met while 'not Strip'"),
        ("G[0,40] (call > 0.5 -> F[0,12] Far)", False, None),
        ("F[0,9] call > 0.5", False, "the values that the signals hold rule it out"),
    ],
)
def test_a_proof_says_what_rules_the_formula_out(formula, wall, said):
    signals = {"call": 0.0} if "call" in formula else {}
    strip = {"type": "rectangle", "min": [4.0, -1.0], "max": [4.8, 3.0]}
    places = {"Near": circle(2.0), "Soon": circle(2.85), "Far": circle(6.0), "Strip": strip}
    task = hall(formula, places, wall, signals=signals)
    why = proof(task, make_body(task.robot, task.grid), np.array([[2.0, 1.0, 0.0]]), {})
    assert (why is None) is (said is None), why
    assert said is None or said in why


def test_a_signal_that_has_risen_calls_for_what_is_too_far():
    task = hall("G[0,40] (call > 0.5 -> F[0,12] Far)", {"Far": circle(6.0)}, signals={"call": 0.0})
    body, past = make_body(task.robot, task.grid), np.array([[2.0, 1.0, 0.0]] * 3)
    assert proof(task, body, past, {"call": np.array([0.0, 0.0, 0.0])}) is None
    assert "'F[2,14] Far' needs it by step 14" in proof(task, body, past, {"call": np.array([0.0, 0.0, 1.0])})


def test_a_wall_with_a_door_proves_nothing_of_a_turn_through_it():
    occupied = np.zeros((80, 80), bool)
    occupied[:, 40] = True
    occupied[30:42, 40] = False  # a door of 0.6 m
    task = make_task(
        OccupancyGrid(occupied, 0.05), STRETCH, "F[0,40] Far", {"Far": {**circle(3.0), "center": [3.0, 1.75]}}
    )
    body = make_body(task.robot, task.grid)
    assert proof(task, body, np.array([[1.0, 1.75, math.pi]]), {}) is None
    occupied[30:42, 40][:3] = True  # 0.45 m, and the footprint is 0.371 m wide
    assert proof(task, body, np.array([[1.0, 1.75, math.pi]]), {}) is None
    occupied[30:36, 40] = True  # 0.3 m
    sealed = make_task(OccupancyGrid(occupied, 0.05), STRETCH, "F[0,40] Far", task.regions)
    why = proof(sealed, make_body(STRETCH, sealed.grid), np.array([[1.0, 1.75, math.pi]]), {})
    assert "no way leads" in why
