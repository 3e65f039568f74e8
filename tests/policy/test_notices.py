"""What is said of a policy that no start, or hardly one, can be kept by."""

import math

import numpy as np
import pytest

from specshield.policy.notices import notices, odd_turns
from specshield.policy.reachability.policy import Settings
from specshield.reasons.relaxation import way
from specshield.robot import robot_from_json
from specshield.shield.decision import make_shield
from specshield.shield.proposal import Proposal
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid

REGIONS = {
    "Dock": {"type": "circle", "center": [1.5, 1.5], "radius": 0.4},
    "Far": {"type": "circle", "center": [20.0, 20.0], "radius": 1.0},
}
ACTIONS = [{"name": "go", "translate": 0.2}, {"name": "turn", "rotate": 0.7853981633974483}, {"name": "wait"}]


def test_a_turn_in_degrees_is_told_and_half_a_turn_is_not():
    actions = [
        {"name": "left", "rotate": 6},
        {"name": "about", "rotate": -math.pi},
        {"name": "go", "translate": 0.2},
    ]
    robot = robot_from_json({"footprint": {"radius": 0.2}, "actions": actions})
    (told,) = odd_turns(robot)
    assert "the action 'left' turns by 6 radians" in told
    assert "6 degrees would be 0.1047 radians" in told  # pi / 30
    policy = Policy("F[0,3] x > 0")
    policy.task = make_task(policy.task.grid, robot, "F[0,3] x > 0")
    assert notices(policy)[0] == told


class Policy:
    """Stands, or does what a search finds."""

    id = "of a test"

    def __init__(self, formula, searches=False, radius=0.2, signals=None):
        robot = robot_from_json({"footprint": {"radius": radius}, "actions": ACTIONS})
        grid = OccupancyGrid(np.zeros((30, 30), bool), 0.1)
        self.task = make_task(grid, robot, formula, REGIONS, signals=signals)
        self.searches = searches

    def propose(self, history, signals, margin):
        found = way(make_shield([self]), history, signals) if self.searches else None
        still = np.full(self.task.horizon + 1 - len(history), 2)
        return Proposal((still if found is None else found)[None], 2)


def test_a_policy_that_serves_its_rule_is_not_warned_of():
    assert notices(Policy("F[0,40] Dock", searches=True)) == ()


def test_a_policy_that_misses_what_a_search_finds_is_said_to():
    policy = Policy("F[0,40] Dock")
    (said,) = notices(policy)
    assert said.endswith("of these: another method may find more")  # nothing of a pitch that it has not
    policy.settings = Settings()
    (said,) = notices(policy)
    assert "it hardly sees some predicate of the formula; a smaller options.pitch or another method" in said


@pytest.mark.parametrize(
    "part", ["not Far", "not touches(Far)", "abs(theta) < 45", "theta < 90 or Dock", "(Far -> Dock)"]
)
def test_a_part_of_the_rule_that_asks_for_nothing_is_told(part):
    """A place that is off the map forbids nothing there, nor does an angle that was meant in degrees."""
    (said,) = notices(Policy(f"F[0,40] Dock and G[0,40] {part}", searches=True))
    assert "holds wherever the robot fits, so it asks for nothing" in said
    asked = "F[0,40] Dock and G[0,40] (not Dock or abs(theta) < 3 or y > 1.5)"
    assert notices(Policy(asked, searches=True)) == ()


def test_a_contradiction_is_said_to_be_one():
    (said,) = notices(Policy("F[0,9] Dock and G[0,9] not Dock"))
    assert said.startswith("no start satisfies this formula: F[0,9] Dock asks for 'Dock and not Dock'")


def test_a_robot_that_fits_nowhere_is_said_not_to():
    (said,) = notices(Policy("F[0,9] Dock", radius=2.0))
    assert "fits" in said


@pytest.mark.parametrize("formula", ["F[0,9] 1 / 0 > 0", "Dock and not Dock and x > 9"])
def test_a_rule_that_no_start_keeps_is_said_to_be_none(formula):
    (said,) = notices(Policy(formula))
    assert said.startswith("no ")


def test_a_rule_that_asks_for_too_much_from_everywhere():
    (said,) = notices(Policy("F[0,1] (Dock and F[1,1] not touches(Dock))", searches=True))
    assert said == "no future that satisfies the formula was found from any of 16 random starts"


def test_a_rule_that_answers_signals_is_told_what_becomes_of_it_when_they_rise():
    near = "G[0,6] (call > 0.5 -> F[0,30] Dock)"  # from everywhere on this floor
    far = "G[0,6] (call > 0.5 -> F[0,2] Dock)"
    assert notices(Policy(near, searches=True, signals={"call": 0.0})) == ()
    (said,) = notices(Policy(far, searches=True, signals={"call": 0.0}))
    assert said.startswith("of 16 random starts, the rule can be kept from ")
    assert int(said.split("can be kept from ")[1].split()[0]) < 8
    (said,) = notices(Policy("G[0,6] (call > x -> F[0,30] Dock)", searches=True, signals={"call": 0.0}))
    assert said.startswith("nothing can be said of signals that change")
