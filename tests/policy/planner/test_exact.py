"""What descending the fields does not find: starts near a deadline, and narrow places."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import deadlines
from specshield.episode import decide, make_shield, start
from specshield.policy.notices import may_begin
from specshield.policy.planner.due_dates import NO_DATE
from specshield.policy.planner.exact import _reach
from specshield.policy.planner.first_motions import make_way
from specshield.policy.planner.policy import Settings, synthesise
from specshield.policy.planner.way import BEGIN, UNTIL
from specshield.policy.tree import make_tree
from specshield.robot import STRETCH, robot_from_json
from specshield.robot.dynamics import make_body, simulate
from specshield.stl import robustness
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.cells import CELL, ROBOT, STATES, WALLS, Cells
from tests.policy.rooms import OCCUPIED, REGIONS, flat

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


@pytest.mark.parametrize("rule", ["F[0,60] East", "F[60,61] East or F[60,61] Wall"])
def test_a_choice_of_places_is_searched_for_as_one_place_is(rule):
    """The door that the fields lead through is shut on a session's own map. No literal of a choice is due."""
    occupied = OCCUPIED.copy()
    occupied[25:, 20] = False
    wall = {"type": "circle", "center": [2.05, 0.3], "radius": 0.04}
    task = flat(rule, regions=REGIONS | {"Wall": wall})
    task = replace(task, grid=replace(task.grid, occupied=occupied))
    shut = occupied.copy()
    shut[10:20, 20] = True
    policy, body = synthesise(task), make_body(task.robot, replace(task.grid, occupied=shut))
    start = np.array([*task.grid.to_map([1.6, 1.2]), 0.3])
    ways = policy.on_body(body).propose(start[None], {}, 0.0).motions
    poses = np.empty((*ways.shape, 3))
    for motions, led in zip(ways, poses, strict=True):
        simulate(body, start, motions, led)
    driven = [task.samples(np.concatenate([start[None], led])) for led in poses]
    assert any(robustness(task.formula, each) > 0.0 for each in driven)


@pytest.mark.parametrize(("first", "later"), [(1.0, 0.0), (0.0, 1.0)])
def test_what_a_signal_forbids_when_a_policy_is_made_bars_no_way_once_it_allows_it(first, later):
    """Against every future of a small world, from each start; the first sample is not the declared value."""
    rule, cells = "F[0,6] A and G[0,6] (person > 0.5 -> not B)", {"A": (1, 2), "B": (2, 2)}
    world = Cells(
        rule, lambda s: s["A"].any(-1) & ~(s["B"].any(-1) & (later > 0.5)), cells, {"person": first}
    )
    shield, some = make_shield([synthesise(world.task, Settings(pitch=0.2))]), 0
    for state in STATES:
        pose = world.pose(*state)
        if WALLS[state[1]][state[0]] == "." and not (later and state[:2] == cells["B"]):
            decision = decide(shield, [pose], np.zeros(5), signals={"person": np.array([later])})
            expected = world.feasible([pose])
            assert [j == 1.0 for j in decision.j_values[:4]] == expected.tolist()
            some += expected.any()
    assert some > 20


def test_poses_that_break_the_rule_take_no_room():
    """From the middle of a place that is not to be left 38 of 40 motions lead out of it. The search makes 64
    poses, of which the table has room for twice as many, and turns on the spot: it ends without a way.
    """
    leaving = [{"name": f"m{n}", "translate": 1.0 + 0.025 * n} for n in range(38)]
    turns = [{"name": f"t{n}", "rotate": n * math.radians(6.0)} for n in (1, -1)]
    robot = robot_from_json({"footprint": {"radius": 0.1}, "actions": leaving + turns})
    regions = {"Home": {"type": "circle", "center": [2.45, 2.45], "radius": 0.5}}
    regions |= {"Dock": {"type": "circle", "center": [4.4, 4.4], "radius": 0.3}}
    task = make_task(ROOM, robot, "F[0,60] Dock and F[0,60] Home", regions)
    world = synthesise(task, Settings(pitch=0.3))._world
    way, tree, need = make_way(world, 0, 60, np.empty(0)), make_tree(64, 0), np.full((2, 4), -1, np.int64)
    way.poses[0] = 2.45, 2.45, 0.0
    need[:, BEGIN], need[1, BEGIN], need[1, UNTIL] = NO_DATE, 0, 60
    length, made = _reach(world, way, 0, world.field[0, 0], 0, 60, need, tree, 64, 0.03)
    assert length == -1
    assert made > 20
    assert (tree.table >= 0).sum() == made - 1  # all but x_t


def begins_in_a_corridor(rule, heading):
    """Of four cells, A to B, and 2 cm wider than the robot: nowhere on the lattice's points does it fit."""
    corridor = OccupancyGrid(np.zeros((1, 4), bool), CELL)
    places = {"A": ([0.0, 0.0], [CELL, CELL]), "B": ([3 * CELL, 0.0], [4 * CELL, CELL])}
    regions = {name: {"type": "rectangle", "min": low, "max": high} for name, (low, high) in places.items()}
    shield = make_shield([synthesise(make_task(corridor, ROBOT, rule, regions))])
    return may_begin(shield, [CELL / 2, CELL / 2, math.remainder(heading * math.pi / 2, math.tau)])


@pytest.mark.parametrize("heading", range(4))
def test_a_passage_hardly_wider_than_the_robot_is_gone_through(heading):
    needed = 3 + min(heading, 4 - heading)
    assert begins_in_a_corridor(f"G[0,6] (A -> F[0,{needed}] B)", heading)
    assert not begins_in_a_corridor(f"G[0,6] (A -> F[0,{needed - 1}] B)", heading)


def test_a_place_is_gone_to_late_where_it_begins_what_cannot_be_answered():
    assert begins_in_a_corridor("F[0,7] B and G[0,6] (B -> F[0,1] A)", 0)
    assert not begins_in_a_corridor("F[0,6] B and G[0,6] (B -> F[0,1] A)", 0)
