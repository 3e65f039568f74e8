"""A world that is not as the map says: what a session is told, or runs into, counts in that very decision.

A room of 4 x 2 m; the goal is at its right end. In the middle of the real world stands something 0.3 m wide
that is not on the map.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from specshield.caution import findings
from specshield.caution.experience import FORMAT, Seen
from specshield.caution.noise import Care
from specshield.caution.surprise.barred import is_barred
from specshield.caution.surprise.contact import NEAR, Followed, contact_of
from specshield.caution.surprise.doubt import recovered
from specshield.caution.surprise.vain import barred_by
from specshield.caution.taught import Taught, on_map, wary
from specshield.episode import Carry, Config, decide, make_shield
from specshield.policy.planner.policy import Settings as Plan
from specshield.policy.planner.policy import synthesise as plan
from specshield.policy.reachability.policy import Settings
from specshield.robot import STRETCH, Action, Robot
from specshield.robot.dynamics import in_collision, make_body, step
from specshield.shield.uncertainty import Uncertainty
from specshield.task import make_task
from specshield.world.learned import CONTACT, SENT, LearnedMap, applied, learn, revised
from specshield.world.occupancy import OccupancyGrid
from tests.made import synthesise
from tests.oracles.cells import FORWARD, LEFT, Cells, Scripted

GOAL = {"type": "circle", "center": [3.5, 1.0], "radius": 0.4}
START = (0.6, 1.0, 0.0)
BOX = [(x, y) for x in np.arange(1.825, 2.1, 0.05) for y in np.arange(0.875, 1.15, 0.05)]
AHEAD, BACK = STRETCH.action_names.index("m"), STRETCH.action_names.index("b")


@cache
def room(steps=40):
    grid = OccupancyGrid(np.zeros((40, 80), bool), 0.05)
    return synthesise(make_task(grid, STRETCH, f"F[0,{steps}] Goal", {"Goal": GOAL}), Settings(pitch=0.1))


def shield_of(steps=40, **config):
    return make_shield([room(steps)], Config(**config))


def real_world():
    grid = room().task.grid
    occupied = grid.occupied.copy()
    for x, y in BOX:
        occupied[int(y / 0.05), int(x / 0.05)] = True
    return make_body(STRETCH, replace(grid, occupied=occupied))


def drive(shield, sees=None):
    """The robot does what completes the rule. Its states and the last decision. sees: points at each step."""
    body, poses, carry = real_world(), [START], None
    while True:
        decision = decide(shield, poses, None, main_task_done=True, carry=carry, occupied=sees)
        carry = decision.carry
        if decision.spec_status != "pending" or len(poses) > shield.task.horizon:
            return poses, decision
        motion = int(STRETCH.motion_of[decision.action])
        poses.append(step(body, *poses[-1], motion))


def test_what_is_not_on_the_map_breaks_the_rule_of_a_session_that_does_not_learn():
    _, last = drive(shield_of(22))
    assert last.spec_status == "violated"
    assert last.map_revision == 0
    assert last.carry.learned is None


def test_what_sensors_see_counts_in_the_same_decision_and_a_way_around_is_found():
    shield = shield_of(30)
    told = decide(shield, [START], None, True, occupied=BOX)
    assert told.map_revision == 1
    assert max(told.j_values) == 1.0
    pose, body = np.array(START), real_world()
    for action in [told.action, *told.witness]:  # its witness is simulated in the real world, by f alone
        pose = np.array(step(body, *pose, STRETCH.motion_of[action]))
        assert not in_collision(body, *pose)
    poses, last = drive(shield, sees=BOX)
    assert last.spec_status == "satisfied"
    assert not any(in_collision(body, *pose) for pose in poses)


def test_a_robot_without_sensors_learns_from_what_it_runs_into():
    _, last = drive(shield_of(60, learn_map=True))
    assert last.spec_status == "satisfied"
    assert last.map_revision >= 1


@pytest.mark.parametrize("heading", [0.0, 1.0])
def test_what_stopped_a_move_that_did_not_begin_is_taken_to_be_half_way(heading):
    """A robot that stays where it is does so wherever on its way the thing stands."""
    robot = Robot("stays", 0.2, (0.0, 0.0), "stay", (Action("on", 0.4), Action("left", rotate=0.5)))
    task = make_task(room().task.grid, robot, "F[0,40] x > 3.5 or F[0,40] y > 1.7")
    shield, pose, carry = make_shield([plan(task, Plan())], Config(learn_map=True)), (1.0, 0.5, heading), None
    for t in range(3):  # twice nothing happens
        carry = decide(shield, [pose] * (t + 1), [9.0, -9.0], carry=carry).carry
    known = Taught.from_bytes(carry.learned).map
    y, x = np.divmod(known.cell[known.occupied & (known.by == CONTACT)], task.grid.width) * np.array(0.05)
    ahead = (x + 0.025 - 1.0) * math.cos(heading) + (y + 0.025 - 0.5) * math.sin(heading)
    assert ahead.min() > 0.35  # the front is at 0.2 m, and half way at 0.4 m
    assert ahead.max() < 0.5


@pytest.mark.parametrize(("gap", "counts"), [(0.15, True), (0.5, False)])
def test_who_stands_still_beside_what_was_touched_has_met_it_again(gap, counts):
    """Far from all that was touched the first time may be a slip. Beside it no second step is spent."""
    shield, left = shield_of(40, learn_map=True, uncertainty=Uncertainty()), STRETCH.action_names.index("l")
    logits = np.where(np.arange(len(STRETCH.actions)) == left, 30.0, -30.0)
    carry = decide(shield, [START], logits).carry
    before, row = Taught.from_bytes(carry.learned), 20 + int((STRETCH.radius + gap) / 0.05)
    cells = row * shield.task.grid.width + np.array([9, 10])
    touched = revised(before.map, learn(shield.task.grid, before.map, 0, cells, True, CONTACT))
    carry = carry._replace(learned=before._replace(map=touched).to_bytes())
    after = decide(shield, [START, START], logits, carry=carry)
    bars = [motion for *_, motion in after.carry.stuck]
    assert (int(STRETCH.motion_of[left]) in bars) == counts


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_robot_that_something_meets_at_its_side_gets_free(side):
    """A door of 1 m, and at its one side a thing 0.3 m wide: what stops the robot is not straight ahead."""
    walls = np.zeros((40, 80), bool)
    walls[:10, 38:42] = walls[30:, 38:42] = True
    grid = OccupancyGrid(walls, 0.05)
    policy = synthesise(make_task(grid, STRETCH, "F[0,70] Goal", {"Goal": GOAL}), Settings(pitch=0.1))
    real = grid.occupied.copy()
    rows = slice(24, 30) if side > 0.0 else slice(10, 16)
    real[rows, 37:43] = True
    body = make_body(STRETCH, replace(grid, occupied=real))
    shield, poses, carry = make_shield([policy], Config(learn_map=True)), [(0.6, 1.0 + 0.1 * side, 0.0)], None
    while len(poses) <= policy.task.horizon:
        decision = decide(shield, poses, None, main_task_done=True, carry=carry)
        carry = decision.carry
        poses.append(step(body, *poses[-1], int(STRETCH.motion_of[decision.action])))
    assert decision.map_revision >= 1
    assert decision.spec_status == "satisfied"


def test_no_motion_is_certified_because_a_mere_mark_would_stop_it():
    """The place right of x = 1.2 is forbidden, and a mark, not a wall, stops the robot before it."""
    grid = room().task.grid
    regions = {
        "Goal": GOAL | {"center": [0.5, 1.0]},
        "Right": {"type": "rectangle", "min": [1.2, 0.0], "max": [4.0, 2.0]},
    }
    task = make_task(grid, STRETCH, "G[0,20] not Right and F[10,20] Goal", regions)
    shield = make_shield([synthesise(task, Settings(pitch=0.1))], Config(learn_map=True))
    poses = [(1.05, 1.0, 0.0)]
    assert decide(shield, poses, None, True).j_values[AHEAD] == 0.0
    wall = learn(grid, LearnedMap(revision=1), 0, np.arange(15 * 80 + 24, 25 * 80, 80), True, CONTACT)
    marked = Taught(wall)
    carry = decide(shield, poses, None, True).carry._replace(t=0, learned=marked.to_bytes())
    found = decide(shield, [*poses, *poses], None, True, carry=carry)
    ends = on_map(shield, marked.map).body
    assert step(ends, *poses[0], AHEAD)[0] < 1.2
    assert found.j_values[AHEAD] == 0.0
    assert max(found.j_values) == 1.0


@pytest.mark.parametrize(
    ("config", "allowed"),
    [
        ({"learn_map": True, "uncertainty": Uncertainty(0.0, 0.0, 0.0)}, False),
        ({"learn_map": True}, True),
        ({}, True),
    ],
)
def test_no_motion_is_kept_out_of_a_forbidden_place_by_a_wall_alone(config, allowed):
    """The wall may stand a little farther on than the map has it. What is not uncertain relies on it."""
    occupied = np.zeros((40, 80), bool)
    occupied[:, 40] = True  # x from 2.0 to 2.05 m; behind it lies what is forbidden
    places = {
        "Goal": {"type": "circle", "center": [0.6, 1.0], "radius": 0.4},
        "Behind": {"type": "rectangle", "min": [2.05, 0.0], "max": [4.0, 2.0]},
    }
    task = make_task(OccupancyGrid(occupied, 0.05), STRETCH, "F[0,40] Goal and G[0,40] not Behind", places)
    shield = make_shield([synthesise(task, Settings(pitch=0.1))], Config(**config))
    near = decide(shield, [(1.89, 1.0, 0.0)], np.zeros(20))
    assert near.next_poses[AHEAD][0] < 2.0  # the wall stops it
    assert near.j_values[AHEAD] == float(allowed)
    assert near.j_values[BACK] == 1.0
    away = decide(shield, [(1.8, 1.0, 0.0)], np.zeros(20))  # 0.2 m on, it would still be before it
    assert away.j_values[AHEAD] == 1.0


def test_a_way_that_does_is_not_changed_for_a_better_one():
    """A robot that takes the best way at each step may go to and fro between two, and never arrive."""
    shield = shield_of(learn_map=True, uncertainty=Uncertainty(0.0, 0.0, 0.0))
    turn, wait = (STRETCH.action_names.index(name) for name in ("ls", "sub_done"))
    motions = STRETCH.motion_of[[turn, *[AHEAD] * 14, *[wait] * 25]]
    carry = Carry(-2, np.empty((len(STRETCH.motions), 3)), (), way=bytes(motions.tolist()))
    decision = decide(shield, [START], None, True, carry=carry)
    assert decision.action == turn
    assert decision.witness == (*[AHEAD] * 14, *[wait] * 25)
    assert decision.robustness[turn] == pytest.approx(0.085, abs=0.001)  # it ends at the goal's side
    exact = shield_of(slack=5)  # a world that is as told: the best way of each motion, whatever was begun
    for told, way in ((shield, None), (exact, None), (exact, carry)):
        assert decide(told, [START], None, True, carry=way).robustness[turn] > 0.09


def test_where_the_arithmetic_ends_nothing_is_relied_on():
    """One centimetre behind the wall the rule's formula divides by zero."""
    occupied = np.zeros((40, 80), bool)
    occupied[:, 40] = True
    goal = {"Goal": {"type": "circle", "center": [0.6, 1.0], "radius": 0.4}}
    formula = "F[0,40] Goal and G[0,40] 1/(2.09 - x) > 0.1"
    task = make_task(OccupancyGrid(occupied, 0.05), STRETCH, formula, goal)
    config = Config(learn_map=True, uncertainty=Uncertainty(0.0, 0.0, 0.0))
    decision = decide(
        make_shield([synthesise(task, Settings(pitch=0.1))], config), [(1.89, 1.0, 0.0)], np.zeros(20)
    )
    assert decision.j_values[AHEAD] == 0.0
    assert decision.j_values[BACK] == 1.0


def test_what_is_free_again_is_unlearned_and_the_policy_never_changes():
    shield = shield_of(30)
    first = decide(shield, [START], None, True, occupied=BOX)
    second = decide(shield, [START, START], None, True, carry=first.carry, free=BOX)
    assert second.map_revision == 2
    plain = decide(shield, [START, START], None, True)
    assert second.robustness == plain.robustness
    assert shield.body.occupied.sum() == 0


def test_occupied_points_are_forgotten_after_the_steps_asked_for():
    shield = shield_of(30, map_memory=2)
    decision = decide(shield, [START], None, True, occupied=BOX)
    for t in range(1, 4):
        decision = decide(shield, [START] * (t + 1), None, True, carry=decision.carry)
        assert decision.map_revision == (1 if t < 3 else 2)


def test_a_decision_is_the_same_where_the_carry_was_stored_and_the_process_is_another():
    shield = shield_of(30, learn_map=True)
    first = decide(shield, [START], None, True, occupied=BOX)
    on_map(shield, Taught.from_bytes(first.carry.learned).map)
    stored = first.carry._replace(learned=bytes(first.carry.learned))
    again = decide(shield_of(30, learn_map=True), [START], None, True, occupied=BOX)
    assert again.carry.learned == stored.learned
    assert again.witness == first.witness


def test_points_under_the_robot_are_ignored_and_said():
    """Such as a scanner sees of the robot itself."""
    decision = decide(shield_of(30), [START], None, True, occupied=[START[:2]])
    assert decision.map_revision == 0
    assert decision.warnings == ("`occupied` points under the robot were ignored: it stands there",)


@pytest.mark.parametrize(("gone", "seen_at", "passed"), [(1.2, 0.4, False), (0.2, 0.2, True)])
def test_what_lies_half_way_of_a_jump_of_the_pose_was_not_passed(gone, seen_at, passed):
    """A robot that is carried, or whose localisation jumps, has not driven through what was seen between."""
    shield, (x, y, _) = shield_of(learn_map=True), START
    box = [(x + seen_at + dx, y + dy) for dx in (0.0, 0.05) for dy in (-0.05, 0.0, 0.05)]
    first = decide(shield, [START], None, main_task_done=True, occupied=box)
    there = (x + gone, y, 0.0)
    second = decide(shield, [START, there], None, main_task_done=True, carry=first.carry)
    left = Taught.from_bytes(second.carry.learned).map.cell
    assert (len(left) < len(Taught.from_bytes(first.carry.learned).map.cell)) is passed


def test_points_outside_the_map_are_ignored_and_said():
    decision = decide(shield_of(30), [START], None, True, occupied=[(50.0, 1.0)])
    assert decision.map_revision == 0
    assert decision.warnings == ("1 points lie outside the map and were ignored",)


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_not_taken_for_a_contact(seed):
    random, body = np.random.default_rng(seed), shield_of().body
    shield = shield_of(40, learn_map=True, seed=seed)
    poses, carry = [START], None
    for _ in range(30):
        decision = decide(shield, poses, np.zeros(len(STRETCH.actions)), carry=carry)
        carry = decision.carry
        motion = int(STRETCH.motion_of[decision.action])
        if motion < 0:
            break
        x, y, theta = step(body, *poses[-1], motion)
        noisy = (x + random.normal(0, 0.01), y + random.normal(0, 0.01), theta + random.normal(0, 0.0087))
        slips = random.random() < 0.05
        poses.append(poses[-1] if slips or in_collision(body, *noisy) else noisy)
    assert decision.map_revision == 0


def test_a_turn_that_no_map_explains_is_tried_twice_and_no_more():
    """The robot is told that its footprint is centred: it cannot know why its back hinders a turn."""
    walls = np.zeros((40, 80), bool)
    walls[30:, 4:18] = True
    grid, told = OccupancyGrid(walls, 0.05), replace(STRETCH, offset=(0.0, 0.0))
    task = make_task(grid, told, "F[0,30] Goal", {"Goal": GOAL | {"center": [0.8, 0.4]}})
    shield = make_shield([synthesise(task, Settings(pitch=0.1))], Config(learn_map=True))
    real, poses, carry = make_body(STRETCH, grid), [(0.8, 1.31, 0.0)], None
    in_vain = []
    while len(poses) <= task.horizon:
        decision = decide(shield, poses, None, main_task_done=True, carry=carry)
        motion, carry = int(STRETCH.motion_of[decision.action]), decision.carry
        poses.append(step(real, *poses[-1], motion))
        in_vain += [(*poses[-1], motion)] if poses[-1] == poses[-2] and motion != STRETCH.wait_motion else []
    assert decision.spec_status == "satisfied"
    assert max(map(in_vain.count, in_vain)) == 2


@pytest.mark.parametrize("noise", [0.0, 0.003])
@pytest.mark.parametrize("over", ["step", "episode"])
def test_a_motion_that_leads_nowhere_is_not_tried_for_ever(over, noise):
    """The model wants to turn left, and the robot cannot turn: nothing on any map says why."""
    left, random = STRETCH.action_names.index("l"), np.random.default_rng(1)
    grid = OccupancyGrid(np.zeros((60, 60), bool), 0.05)
    task = make_task(grid, replace(STRETCH, offset=(0.0, 0.0)), "F[0,60] x > 2.2")
    shield = make_shield(
        [synthesise(task)], Config(learn_map=True, uncertainty=Uncertainty(), threshold_over=over)
    )
    logits = np.where(np.arange(len(STRETCH.actions)) == left, 3.0, -8.0)
    poses, carry, drawn = [[1.0, 1.0, math.pi / 2]], None, []
    for _ in range(8):
        decision = decide(shield, poses, logits, carry=carry)
        carry, at = decision.carry, poses[-1]
        drawn.append(decision.action)
        if decision.action in (AHEAD, BACK):
            at = decision.next_poses[decision.action].tolist()
        poses.append((np.array(at) + random.normal(0.0, noise, 3)).tolist())
    assert drawn[0] == left
    assert any(action != left for action in drawn[4:])
    assert int(STRETCH.motion_of[left]) in [motion for *_, motion in carry.stuck]


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_a_wall_4_cm_nearer_than_told_is_not_pushed_for_ever(noise):
    """f leads on to the wall that it knows, by less than noise can be. The robot does not move at all."""
    random, walls = np.random.default_rng(1), np.zeros((2, 100, 150), bool)
    walls[0, :, 125:], walls[1, :, 123:] = True, True  # as told, as it is
    grids = [OccupancyGrid(each, 0.02) for each in walls]
    task = make_task(grids[0], STRETCH, "F[0,60] x < 0.6")
    shield = make_shield([synthesise(task)], Config(learn_map=True, uncertainty=Uncertainty()))
    logits = np.where(np.arange(len(STRETCH.actions)) == AHEAD, 3.0, -8.0)
    real, poses, carry, drawn = make_body(STRETCH, grids[1]), [(1.9, 1.0, 0.0)], None, []
    for _ in range(20):
        decision = decide(shield, poses, logits, carry=carry)
        carry = decision.carry
        drawn.append(decision.action)
        ended = step(real, *poses[-1], int(STRETCH.motion_of[decision.action]))
        noisy = tuple((np.array(ended) + random.normal(0.0, noise, 3)).tolist())
        poses.append(ended if in_collision(real, *noisy) else noisy)
    assert drawn[:3] == [AHEAD] * 3
    assert BACK in drawn
    assert drawn.count(AHEAD) < 12
    assert decision.map_revision > 0


@pytest.mark.parametrize(
    ("formula", "stays"), [("F[0,64] Goal", 35), ("F[0,64] Goal and F[64,110] Home", 40)]
)
def test_what_came_in_the_only_way_is_waited_for_before_it_and_passed_when_it_has_gone(formula, stays):
    """A wall with one gap, and someone in it: nothing else leads to what is behind the wall.

    From where the goal is nearest, at the wall, there would be too little time left; and from where the way
    to Home leads, which can be driven at any time.
    """
    walls = np.zeros((40, 80), bool)
    walls[19:21, :56] = True
    someone = [(x, 1.0) for x in np.arange(2.825, 4.0, 0.05)]
    places, pose = {"Goal": [0.6, 0.45], "Home": [0.6, 1.55]}, (2.0, 1.5, 0.0)
    regions = {name: {"type": "circle", "center": at, "radius": 0.35} for name, at in places.items()}
    task = make_task(OccupancyGrid(walls, 0.05), STRETCH, formula, regions)
    shield = make_shield([synthesise(task, Settings(pitch=0.1))], Config(learn_map=True))
    there = task.grid.occupied.copy()
    there[20, 56:] = True
    bodies = make_body(STRETCH, replace(task.grid, occupied=there)), shield.body
    poses, carry, said = [pose], None, []
    for t in range(task.horizon + 1):
        gone = t >= stays
        points = {"free": someone} if gone else {"occupied": someone}
        decision = decide(shield, poses, None, main_task_done=True, carry=carry, **points)
        carry, said = decision.carry, [*said, decision.mode]
        if decision.spec_status != "pending":
            break
        motion = int(STRETCH.motion_of[decision.action])
        if not gone:  # it never drives into who is there
            assert step(bodies[0], *poses[-1], motion) == step(bodies[1], *poses[-1], motion)
        poses.append(step(bodies[gone], *poses[-1], motion))
    assert decision.spec_status == "satisfied"
    assert set(said[:stays]) == {"fallback"}
    assert poses[20] == poses[stays]


@pytest.mark.parametrize("gap", [5e-7, 0.004])
def test_a_robot_that_can_come_no_nearer_stands_and_does_not_push_what_is_seen(gap):
    """A wall right across the room, just ahead, and no time left to wait for a way: at step 0 and later."""
    wall = [(2.425, y) for y in np.arange(0.025, 2.0, 0.05)]
    pose = (2.4 - STRETCH.radius - STRETCH.offset[0] - gap, 1.0, 0.0)
    for shield in (shield_of(2, learn_map=True), shield_of(2, learn_map=True, uncertainty=Uncertainty())):
        decision = decide(shield, [pose], None, True, occupied=wall)
        assert (decision.mode, decision.reason) == ("fallback", "infeasible")
        again = decide(shield, [pose, pose], None, True, carry=decision.carry, occupied=wall)
        for action in (decision.action, again.action):
            assert int(STRETCH.motion_of[action]) == STRETCH.wait_motion


@pytest.mark.parametrize(
    ("rule", "poses", "make"),
    [  # it was nearer before; it was 5 cm inside Start, and the rule cannot be missed by more than that
        ("F[0,5] Goal", [(1.2, 1.0, 0.0), (1.0, 1.0, 0.0), (0.8, 1.0, 0.0)], synthesise),
        ("G[0,3] (Start -> F[0,9] Goal)", [START, START], plan),
    ],
)
def test_a_robot_that_will_be_late_goes_on_all_the_same_whatever_its_past_is_worth(rule, poses, make):
    begin = {"type": "circle", "center": [0.6, 1.0], "radius": 0.05}
    policy = make(make_task(room().task.grid, STRETCH, rule, {"Goal": GOAL, "Start": begin}))
    shield = make_shield([policy], Config(learn_map=True, uncertainty=Uncertainty()))
    decision = decide(shield, poses, None, main_task_done=True)
    assert (decision.mode, decision.action) == ("fallback", AHEAD)


@pytest.mark.parametrize("skin", [0.0, 0.02])
def test_a_robot_whose_scanner_sees_its_own_body_all_round_is_not_shut_in(skin):
    """Points on the footprint's edge, or a little outside: they lie under no more than 3 cm of it."""
    shield, poses, carry = shield_of(30, learn_map=True, uncertainty=Uncertainty()), [START], None
    around = np.linspace(0.0, 2 * math.pi, 60)
    ring = (STRETCH.radius + skin) * np.stack([np.cos(around), np.sin(around)], axis=-1)
    for _ in range(31):
        x, y, theta = poses[-1]
        centre = x + STRETCH.offset[0] * math.cos(theta), y + STRETCH.offset[0] * math.sin(theta)
        decision = decide(shield, poses, None, True, carry=carry, occupied=ring + centre)
        carry = decision.carry
        if decision.spec_status != "pending":
            break
        assert decision.mode == "completion"
        poses.append(step(shield.body, *poses[-1], int(STRETCH.motion_of[decision.action])))
    assert decision.spec_status == "satisfied"


@pytest.mark.parametrize("side", [1, -1])
def test_what_is_met_again_is_first_taken_for_what_was_touched_before_and_is_a_little_larger(side):
    """A thing from the wall to the middle of a room of 2 m, which is in truth 10 cm longer than was marked. A
    robot of 70 cm touches its end. With marks all along the robot's front too, no way is left beside it.
    """
    grid, robot = room().task.grid, replace(STRETCH, name="broad", radius=0.35, offset=(0.0, 0.0))
    policy = synthesise(make_task(grid, robot, "F[0,20] x > 2.8"), Settings(pitch=0.05))
    shield = make_shield([policy], Config(learn_map=True, uncertainty=Uncertainty()))
    marked, real = np.zeros((2, *grid.occupied.shape), bool)
    marked[:18, 36:42] = real[:20, 36:42] = True
    if side < 0:
        marked, real = marked[::-1], real[::-1]
    body = make_body(robot, replace(grid, occupied=real))
    poses = [(0.8, 1.0 + 0.3 * side, 0.0)]
    carry = decide(shield, poses, None, True).carry
    before = Taught.from_bytes(carry.learned)
    known = revised(before.map, learn(grid, before.map, 0, np.flatnonzero(marked), True, CONTACT))
    carry = carry._replace(learned=before._replace(map=known).to_bytes())
    poses.append(poses[0])
    while len(poses) <= policy.task.horizon + 1:
        decision = decide(shield, poses, None, True, carry=carry)
        carry = decision.carry
        poses.append(step(body, *poses[-1], int(STRETCH.motion_of[decision.action])))
    assert decision.map_revision > 1
    assert decision.spec_status == "satisfied"


@pytest.mark.parametrize("off", [1, -1])
def test_what_was_touched_is_first_taken_for_what_the_map_has_a_little_elsewhere(off):
    """A door of 90 cm that is in truth 5 cm farther on one side, and a robot of 70 cm: it touches the frame
    with one side of its front. With marks all along its front, and half of it, the door is too narrow.
    """

    def door(left):
        walls = np.zeros((60, 60), bool)
        walls[29:31] = True
        walls[29:31, left : left + 18] = False
        return OccupancyGrid(walls, 0.05)

    robot = replace(STRETCH, name="broad", radius=0.35, offset=(0.0, 0.0))
    goal = {"Goal": {"type": "circle", "center": [1.5, 2.4], "radius": 0.2}}
    policy = synthesise(make_task(door(21), robot, "F[0,13] Goal", goal), Settings(pitch=0.05))
    shield = make_shield([policy], Config(learn_map=True, uncertainty=Uncertainty()))
    body, poses, carry = make_body(robot, door(21 + off)), [(1.5 - 0.08 * off, 0.7, math.pi / 2)], None
    for _ in range(14):
        decision = decide(shield, poses, None, True, carry=carry)
        carry = decision.carry
        poses.append(step(body, *poses[-1], int(STRETCH.motion_of[decision.action])))
    assert decision.map_revision > 0
    assert decision.spec_status == "satisfied"


def test_a_robot_of_small_motions_keeps_more_time_for_a_way_around():
    """20 steps of a Stretch are 2 m and 300 degrees."""

    def steps(translate, degrees):
        turn = math.radians(degrees)
        moves = Action("on", translate), Action("back", -translate)
        actions = *moves, Action("left", 0.0, turn), Action("wait")
        robot = Robot("small", 0.1, (0.0, 0.0), "stop", actions)
        task = make_task(OccupancyGrid(np.zeros((20, 20), bool), 0.05), robot, "G[0,9] x > 0", {})
        shield = make_shield([plan(task, Plan())], Config(learn_map=True, uncertainty=Uncertainty()))
        return wary(shield, Care(0.0, 0), Taught(), True).least

    assert [steps(0.2, 30), steps(0.4, 90)] == [20, 20]
    assert [steps(0.1, 30), steps(0.1, 15), steps(0.1, 45)] == [30, 40, 27]


@pytest.mark.parametrize(
    ("learn_map", "later", "tables"),
    [(False, [], False), (True, None, False), (True, [], False), (True, [], True)],
)
def test_what_was_seen_once_in_the_only_way_is_doubted_after_20_steps_in_which_a_sensor_saw_nothing_there(
    learn_map, later, tables
):
    """The wall with one gap again, which one wrong measurement shuts at step 0. tables: whether tables are
    made for the map on which it is shut, as a server does beside the decisions.
    """
    doubts = learn_map and later is not None
    walls = np.zeros((40, 80), bool)
    walls[19:21, :56] = True
    goal, pose = {"Goal": {"type": "circle", "center": [0.6, 0.45], "radius": 0.35}}, (2.0, 1.5, 0.0)
    task = make_task(OccupancyGrid(walls, 0.05), STRETCH, "F[0,64] Goal", goal)
    shield = make_shield([synthesise(task, Settings(pitch=0.1))], Config(learn_map=learn_map))
    poses, carry, modes, said = [pose], None, [], [()]
    for t in range(task.horizon + 1):
        seen = later if t else [(x, 1.0) for x in np.arange(2.825, 4.0, 0.05)]
        decision = decide(shield, poses, None, main_task_done=True, carry=carry, occupied=seen)
        carry = decision.carry
        if decision.spec_status != "pending":
            break
        if tables and t == 0:
            shut = applied(task.grid, Taught.from_bytes(carry.learned).map)
            shield = replace(shield, proposers=tuple(each.remade(shut) for each in shield.proposers))
        modes.append(decision.mode)
        said.append(decision.warnings)
        poses.append(step(shield.body, *poses[-1], int(STRETCH.motion_of[decision.action])))
    assert set(modes[:20]) == {"fallback"}
    assert (decision.spec_status == "satisfied") == doubts
    if doubts:
        assert set(modes[20:]) == {"completion"}
        assert "last seen long ago" in said[21][0]


def test_a_motion_that_goes_on_where_f_stops_it_is_no_noise_and_is_not_relied_on_again():
    shield = shield_of(40, learn_map=True, uncertainty=Uncertainty())
    decision = decide(shield, [START], None, True, occupied=[(0.725, 1.0)])  # 4.85 cm before the footprint
    foreseen, motion = decision.next_poses[AHEAD], int(STRETCH.motion_of[AHEAD])
    assert START[0] < foreseen[0] < START[0] + 0.05
    carry = decision.carry._replace(learned=drawn_by(decision.carry.learned, motion))
    on = [(START[0] + 0.12, 1.0, 0.0), tuple(foreseen), (START[0] + 0.2, 1.0, 0.0)]
    found = [decide(shield, [START, pose], None, True, carry=carry) for pose in on]
    assert [len(each.carry.stuck) for each in found] == [1, 0, 1]
    assert found[0].carry.stuck[0] == (*START, motion)
    seen = [Seen(*FORMAT.unpack(each.carry.residuals)) for each in found]
    assert [(each.noisy, each.lost) for each in seen] == [(0.0, 0.0), (1.0, 0.0), (0.0, 0.0)]
    bars = barred_by(found[0].carry.stuck, (0.0, 0.0))
    near = [is_barred(bars, START[0] + off, 1.0, math.radians(turn), motion) for off, turn in
            [(0.04, 10.0), (0.06, 0.0), (0.0, 14.0)]]  # fmt: skip
    assert near == [True, False, False]


def drawn_by(learned, motion):
    before = Taught.from_bytes(learned)
    return before._replace(followed=before.followed._replace(drawn=motion)).to_bytes()


@pytest.mark.parametrize(("y", "counts"), [(0.35, False), (1.0, True)])
def test_what_stands_beside_something_may_have_met_it_and_is_not_taken_to_slip(y, counts):
    shield = shield_of(40, learn_map=True, uncertainty=Uncertainty())
    pose = (1.0, y, 0.0)  # 16 and 81 cm from the wall
    carry = decide(shield, [pose], None, True).carry
    after = decide(shield, [pose, pose], None, True, carry=carry)
    assert (Seen(*FORMAT.unpack(after.carry.residuals)).lost > 0.0) == counts


@pytest.mark.parametrize("uncertainty", [None, Uncertainty()])
def test_what_is_in_the_way_is_not_waited_for_where_waiting_would_break_the_rule(uncertainty):
    """The robot stands in a zone that it has to leave within 12 steps, and the way to its goal is blocked."""
    grid = OccupancyGrid(np.zeros((20, 120), bool), 0.05)
    regions = {"Goal": GOAL | {"center": [5.3, 0.5]}, "Zone": GOAL | {"center": [3.0, 0.5], "radius": 0.45}}
    task = make_task(grid, STRETCH, "F[0,70] Goal and G[12,80] not Zone", regions)
    policy = synthesise(task, Settings(pitch=0.05))  # not so small that each beam tries nearly every way
    shield = make_shield([policy], Config(learn_map=True, uncertainty=uncertainty))
    blocked = [(x, y) for x in np.arange(3.525, 3.8, 0.05) for y in np.arange(0.025, 1.0, 0.05)]
    there = grid.occupied.copy()
    there[:20, 70:76] = True
    body = make_body(STRETCH, OccupancyGrid(there, 0.05))
    poses, carry = [(3.0, 0.5, 0.0)], None
    for _ in range(14):
        decision = decide(shield, poses, None, True, carry=carry, occupied=blocked)
        carry = decision.carry
        poses.append(step(body, *poses[-1], int(STRETCH.motion_of[decision.action])))
    assert decision.spec_status == "pending"


def test_marks_are_not_blamed_where_nothing_was_marked():
    """No motion of the only step brings the robot nearer to its goal, and it has run into nothing."""
    grid, goal = OccupancyGrid(np.zeros((20, 80), bool), 0.05), {"Goal": GOAL | {"center": [3.5, 0.5]}}
    policy = synthesise(make_task(grid, STRETCH, "F[0,1] Goal", goal), Settings(pitch=0.1))
    decision = decide(make_shield([policy], Config(learn_map=True)), [(0.6, 0.5, math.pi / 2)], None, True)
    assert (decision.mode, decision.reason) == ("fallback", "infeasible")
    assert [said for said in decision.warnings if "no way that was tried keeps F[0,1] Goal" in said]
    assert not [said for said in decision.warnings if "marked" in said]


@pytest.mark.parametrize("method", ["reachability", "planner"])
@pytest.mark.parametrize("formula", ["F[0,20] A and F[20,36] B", "F[0,20] A and F[20,36] B and F[0,21] A"])
def test_what_can_still_be_kept_is_kept_while_another_part_is_lost_but_not_yet_broken(
    method, formula, monkeypatch
):
    """Pushed away to the right end at step 5, the robot is too late for A at the left end. To B it takes 26
    steps: there are 31, and 16 once A is broken.
    """
    grid = OccupancyGrid(np.zeros((20, 180), bool), 0.05)
    regions = {"A": GOAL | {"center": [0.8, 0.5]}, "B": GOAL | {"center": [3.0, 0.5]}}
    task = make_task(grid, STRETCH, formula, regions)
    make = synthesise if method == "reachability" else plan
    policy = make(task, (Settings if method == "reachability" else Plan)(pitch=0.1))
    shield = make_shield([policy], Config(learn_map=True, uncertainty=Uncertainty()))

    def checked(*args):  # the ways that give a part up are not among those that J is read from
        judged = recovered(*args)
        assert len(judged.tried.rho) == len(judged.kept)
        return judged

    monkeypatch.setattr(findings, "recovered", checked)
    poses, carry, said = [(2.0, 0.5, math.pi)], None, []
    for t in range(37):
        decision = decide(shield, poses, None, True, carry=carry)
        carry = decision.carry
        assert t < 5 or decision.spec_status == "violated" or decision.reason == "infeasible"
        said += [each for each in decision.warnings if "B: the nearest misses it" in each]
        moved = step(shield.body, *poses[-1], int(STRETCH.motion_of[decision.action]))
        poses.append((8.6, 0.5, math.pi) if t == 4 else moved)
    assert max(0.4 - math.hypot(x - 3.0, y - 0.5) for x, y, _ in poses[20:37]) > 0.0
    assert said == []


def test_what_a_way_out_keeps_is_kept_though_no_policy_finds_that_way_again():
    """A is too far for its window; for B there is time, but after the first step the policy stands still."""
    cells = Cells("F[0,1] A and F[0,7] B", None, {"A": (4, 4), "B": (2, 0)})
    to_b = {LEFT: [LEFT, FORWARD, FORWARD]}
    policy = Scripted(cells, lambda t, motion: to_b.get(motion, []) if t == 0 else [])
    shield, poses, carry = (
        make_shield([policy], Config(uncertainty=Uncertainty())),
        [cells.pose(0, 0, 2)],
        None,
    )
    for t in range(4):
        decision = decide(shield, poses, None, True, carry=carry)
        assert (decision.witness is None) is (t == 0)  # until A is lost, nothing is certified
        carry = decision.carry
        poses.append(step(shield.body, *poses[-1], int(cells.task.robot.motion_of[decision.action])))
    assert cells.state(poses[-1])[:2] == (2, 0)


def test_where_no_part_can_be_kept_alone_no_ways_are_asked_for_that_keep_two(monkeypatch):
    """Walled in, the robot cannot come to A, B or C. Each way that is asked for costs a search in vain."""
    grid, parts = OccupancyGrid(np.zeros((40, 80), bool), 0.05), "ABC"
    regions = {name: GOAL | {"center": [3.5, 0.5 + 0.5 * k], "radius": 0.2} for k, name in enumerate(parts)}
    task = make_task(grid, STRETCH, " and ".join(f"F[0,40] {name}" for name in parts), regions)
    policy = synthesise(task, Settings(pitch=0.1))
    asked, giving_up = [], type(policy).giving_up
    monkeypatch.setattr(
        type(policy), "giving_up", lambda self, lost: asked.append(lost) or giving_up(self, lost)
    )
    wall = [(1.2, y) for y in np.arange(0.025, 2.0, 0.05)]
    shield = make_shield([policy], Config(learn_map=True, uncertainty=Uncertainty()))
    decision = decide(shield, [START], None, True, occupied=wall)
    assert decision.reason == "infeasible"
    assert [len(lost) for lost in asked] == [2, 2, 2]


def test_what_cannot_be_kept_is_asked_for_with_a_margin_on_the_map_alone_and_not_on_guesses(monkeypatch):
    """A wall across the room leaves no way. What a policy finds with a margin may be missed without one."""
    policy = room(40)
    asked, propose = [], type(policy).propose
    monkeypatch.setattr(
        type(policy),
        "propose",
        lambda self, h, s, margin: asked.append((self.guess, margin)) or propose(self, h, s, margin),
    )
    shield, points = make_shield([policy], Config(margin=0.2, learn_map=True)), np.arange(0.025, 2.0, 0.05)
    wall = learn(
        policy.task.grid, LearnedMap(revision=1), 0, (points / 0.05).astype(int) * 80 + 24, True, SENT
    )
    touched = learn(policy.task.grid, wall, 0, np.array([20 * 80 + 60]), True, CONTACT)
    carry = decide(shield, [START], None, True).carry._replace(t=4, learned=Taught(touched).to_bytes())
    asked.clear()
    decision = decide(shield, [START] * 6, None, True, carry=carry)
    assert decision.reason == "infeasible"
    assert asked[:2] == [(False, 0.2), (False, 0.0)]
    assert (True, 0.0) in asked
    assert (True, 0.2) not in asked


@pytest.mark.parametrize("uncertainty", [None, Uncertainty()])
@pytest.mark.parametrize("steps", [17, 19, 22])
def test_whoever_pauses_within_the_time_that_is_left_is_there_in_time(steps, uncertainty):
    """The caller does nothing for some steps, as after an emergency stop: what was drawn was not in vain."""
    grid, goal = OccupancyGrid(np.zeros((20, 80), bool), 0.05), {"Goal": GOAL | {"center": [3.5, 0.5]}}
    policy = synthesise(make_task(grid, STRETCH, f"F[0,{steps}] Goal", goal), Settings(pitch=0.1))
    shield = make_shield([policy], Config(learn_map=True, uncertainty=uncertainty))
    for pause in range(2, steps - 13 + 1):  # 13 steps lead there
        poses, carry = [(0.6, 0.5, 0.0)], None
        for t in range(steps + 1):
            decision = decide(shield, poses, None, True, carry=carry)
            carry, motion = decision.carry, int(STRETCH.motion_of[decision.action])
            motion = STRETCH.wait_motion if 3 <= t < 3 + pause else motion
            poses.append(step(shield.body, *poses[-1], motion))
            if decision.spec_status != "pending":
                break
        assert decision.spec_status == "satisfied", pause


@pytest.mark.parametrize("uncertainty", [None, Uncertainty()])
def test_who_was_held_for_too_long_is_driven_on_all_the_same(uncertainty):
    """Nothing led anywhere for 14 steps, so the goal is reached too late; then everything works again."""
    grid, goal = OccupancyGrid(np.zeros((20, 80), bool), 0.05), {"Goal": GOAL | {"center": [3.5, 0.5]}}
    policy = synthesise(make_task(grid, STRETCH, "F[0,24] Goal", goal), Settings(pitch=0.1))
    shield = make_shield([policy], Config(learn_map=True, uncertainty=uncertainty))
    poses, carry = [(0.4, 0.5, math.pi)], None  # with a wall before it
    for t in range(24):
        decision = decide(shield, poses, None, True, carry=carry)
        carry, motion = decision.carry, int(STRETCH.motion_of[decision.action])
        poses.append(poses[-1] if 2 <= t < 16 else step(shield.body, *poses[-1], motion))
    assert decision.mode == "fallback"
    assert poses[-1][0] - poses[16][0] > 1.0


@pytest.mark.parametrize("learn_map", [False, True])
def test_ways_for_the_slack_are_asked_for_on_the_way_by_robots_that_may_be_inexact(learn_map):
    uncertain, exact = (shield_of(learn_map=learn_map, uncertainty=u) for u in (Uncertainty(), None))
    found = [wary(uncertain, Care(0.0, 0), Taught(), on_way).on_way for on_way in (True, False)]
    assert found == [True, False]
    assert not wary(exact, Care(0.0, 3), Taught(), True).on_way


def test_a_caller_who_draws_by_itself_and_waits_has_run_into_nothing():
    """Its robot is exact, and nothing stands there. By chance it seems to do what was drawn for a while."""
    wanted = {"m": 0.0, "p": 3.0, "ls": -2.0, "rs": -2.0}  # p: stand
    logits = np.array([wanted.get(name, -np.inf) for name in STRETCH.action_names])
    for seed in range(60):
        shield = shield_of(80, learn_map=True, uncertainty=Uncertainty(), seed=seed)
        own, poses, carry = np.random.default_rng(seed), [START], None
        for _ in range(12):
            found = decide(shield, poses, logits, carry=carry)
            assert found.map_revision == 0
            carry, action = found.carry, int(own.choice(len(logits), p=found.distribution))
            poses.append(step(shield.body, *poses[-1], int(STRETCH.motion_of[action])))


@pytest.mark.parametrize("far", [1e4, 1e19, -1.7e308])
def test_a_pose_that_no_robot_can_have_is_answered(far):
    shield = shield_of(learn_map=True, uncertainty=Uncertainty())
    carry = decide(shield, [START], None, True).carry
    assert decide(shield, [START, (far, 1.0, 0.0)], None, True, carry=carry).in_collision


@pytest.mark.parametrize("make", [synthesise, plan])
def test_a_robot_that_has_passed_what_the_map_has_beside_it_is_not_shut_in_there(make):
    """The wall on its left stands 5 cm farther off than on the map, which learns this only where the robot
    reached into it by more than 3 cm. The rest of the wall, behind, would then block the way back.
    """
    arcs = [Action(f"{far} {turn}", far, turn) for far in (0.2, -0.2) for turn in (0.0, 0.5, -0.5)]
    robot, walls = Robot("arcs", 0.2, (0.0, 0.0), "stop", (*arcs, Action("wait"))), np.zeros((40, 80), bool)
    walls[24:, :40] = True
    goal = {"Goal": GOAL | {"center": [0.8, 0.8]}}
    task = make_task(OccupancyGrid(walls, 0.05), robot, "F[0,60] Goal", goal)
    shield = make_shield([make(task)], Config(learn_map=True, uncertainty=Uncertainty()))
    way, carry = [(1.6, 0.985, 0.19), (1.79, 1.023, 0.19), (1.92, 1.0495, 0.19)], None
    for t in range(3):
        decision = decide(shield, way[: t + 1], None, True, carry=carry)
        carry = decision.carry
    assert decision.mode == "completion"
    assert decision.next_poses[decision.action][0] < 1.8


@pytest.mark.parametrize(
    ("by_chance", "drawn", "follows"), [(1e-4, 1, True), (1e-4, 2, False), (0.5, 1, False)]
)
def test_an_arc_that_something_stops_before_its_turn_does_not_tell_a_caller_that_goes_its_own_ways(
    by_chance, drawn, follows
):
    """It ends where the straight motion does. That is known of a caller who followed for long alone, and of
    no motion that backs off.
    """
    robot = Robot(
        "arcs", 0.2, (0.0, 0.0), "stop", (Action("on", 0.2), Action("arc", 0.2, 0.5), Action("b", -0.2))
    )
    body = make_body(robot, room().task.grid)
    before, after = np.array([1.0, 1.0, 0.0]), np.array([1.18, 1.0, 0.0])
    foreseen = np.array([step(body, *before, motion) for motion in range(3)])
    followed = Followed(drawn=drawn, by_chance=by_chance)
    met, now = contact_of(body, followed, before, after, foreseen, NEAR, False)
    assert met == -1
    assert now.follows == follows
