"""From a first motion onto a way that is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.states import shipped_dqn
from benchmarks.sweep import made_robot, widened
from specshield.episode import decide, make_shield
from specshield.policy.detour import find_sibling, find_twins, join
from specshield.policy.dqn.environment import free_poses
from specshield.policy.reachability import policy as reachability
from specshield.robot import robot_from_json
from specshield.robot.dynamics import make_body, simulate
from specshield.sim.cases import load_case
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.judge import margin
from tests.policy.rooms import OCCUPIED, REGIONS

HALF, THIRD = math.pi / 2.0, math.pi / 3.0
ACTIONS = [{"name": "stay"}, {"name": "go", "translate": 0.2}, {"name": "back", "translate": -0.2}]
ACTIONS += [{"name": f"turn{k}", "rotate": k * THIRD / 2.0} for k in (-2, -1, 1, 2)]
ACTIONS += [{"name": f"arc{k}", "translate": 0.1, "rotate": k * THIRD / 2.0} for k in (-2, -1, 1, 2)]
ARCS = robot_from_json({"footprint": {"radius": 0.2, "offset": [0.06, 0.0]}, "actions": ACTIONS})
"""Nothing undoes an arc: there is no 0.1 m back."""

HOLE = {"type": "rectangle", "min": [1.0, 0.2], "max": [1.4, 0.6]}


def way(*poses):
    return np.array(poses, float)


def test_a_twin_is_the_first_motion_that_ends_in_the_very_same_pose():
    first = [(0, 0, 0), (1, 0, 0), (0, 0, 0), (1, 0, HALF), (1, 0, 0)]
    twin = np.empty(5, np.int64)
    find_twins(np.array(first, float)[:, None], twin)
    assert twin.tolist() == [0, 1, 0, 3, 1]


def test_a_sibling_is_come_upon_after_the_turns_that_begin_its_way():
    body = make_body(ARCS, OccupancyGrid(OCCUPIED, 0.1, (0.0, 0.0, 0.0)))
    poses = np.stack(
        [
            way((1, 2, 0), (1, 2, THIRD), (1, 2, HALF), (1.2, 2, HALF)),  # turns twice, then goes
            way((1, 2, -THIRD / 2.0), (9, 9, 9), (9, 9, 9), (9, 9, 9)),
            way((1, 2, HALF), (9, 9, 9), (9, 9, 9), (9, 9, 9)),
            way((1, 2.5, 0), (9, 9, 9), (9, 9, 9), (9, 9, 9)),
            way((1, 2, 0.123), (9, 9, 9), (9, 9, 9), (9, 9, 9)),
        ]
    )
    left, right = (ARCS.motions.index((0.0, angle)) for angle in (THIRD / 2.0, -THIRD / 2.0))
    assert sibling(body, poses, 1, True) == [0, left, 1]  # to the first heading: it has no turn to the others
    assert sibling(body, poses, 2, True) == [0, -1, 3]  # it faces the last one already
    assert sibling(body, poses, 2, False) == [0, right, 2]  # and may not be early where it cannot wait
    assert sibling(body, poses, 3, True)[0] == -1  # elsewhere
    assert sibling(body, poses, 4, True)[0] == -1  # no turn fits


def sibling(body, poses, motion, waits):
    out = np.empty(3, np.int64)
    find_sibling(body, poses, np.array([0]), motion, waits, out)
    return out.tolist()


WAIT, GO, LEFT, RIGHT, ARC = range(5)
BASE = [GO, GO, WAIT, WAIT, LEFT, WAIT, GO]


@pytest.mark.parametrize(
    ("turn", "move", "at", "wanted"),
    [
        # An arc undone by a turn: behind by two steps, which the next two waits make up for.
        (RIGHT, -1, 0, [ARC, RIGHT, GO, GO, LEFT, WAIT, GO]),
        # By two motions: the third step that is lost shifts the rest to the third wait.
        (RIGHT, LEFT, 0, [ARC, RIGHT, LEFT, GO, GO, LEFT, GO]),
        # Onto the way after its first motion, by a turn: one step behind.
        (RIGHT, -1, 1, [ARC, RIGHT, GO, WAIT, LEFT, WAIT, GO]),
        # From its place after two motions: one step too soon, so it waits.
        (-1, -1, 2, [ARC, WAIT, WAIT, WAIT, LEFT, WAIT, GO]),
    ],
)
def test_steps_lost_are_made_up_for_and_steps_gained_are_waited_for(turn, move, at, wanted):
    motions = np.full(7, ARC)
    join(turn, move, np.array(BASE), at, WAIT, motions)
    assert motions.tolist() == wanted


def test_every_arc_is_certified_where_the_pose_it_leads_to_is_feasible():
    regions = {"West": REGIONS["West"], "East": REGIONS["East"], "Hole": HOLE}
    spec = {"formula": "F[0,30] West and F[20,44] East and G[0,44] not Hole", "regions": regions}
    task = make_task(OccupancyGrid(OCCUPIED, 0.1, (0.0, 0.0, 0.0)), ARCS, spec["formula"], regions)
    shield, body = make_shield([reachability.synthesise(task)]), make_body(ARCS, task.grid)
    logits, certified = np.zeros(len(ACTIONS)), 0
    for pose in free_poses(task, body, 25, np.random.default_rng(3)):
        answer = decide(shield, pose[None], logits, witnesses=True)
        for a, after in enumerate(answer.next_poses):
            onward = decide(shield, np.stack([pose, after]), logits)
            assert bool(answer.j_values[a]) == any(onward.j_values)
            if answer.j_values[a]:
                poses = np.empty((task.horizon, 3))
                simulate(body, pose, ARCS.motion_of[[a, *answer.witnesses[a]]], poses)
                assert margin(spec, [pose, *poses]) > 0.0
                certified += 1
    assert certified > 150


def test_a_learned_policy_shares_ways_too():
    case = load_case("case2")
    task = make_task(case.task.grid, made_robot(40), case.spec["formula"], case.spec["regions"])
    shield, body = make_shield([widened(shipped_dqn(case), task)]), make_body(task.robot, task.grid)
    certified = 0
    for pose in free_poses(task, body, 12, np.random.default_rng(5)):
        answer = decide(shield, pose[None], np.zeros(40), witnesses=True)
        for a in np.flatnonzero(answer.j_values) if answer.mode == "shaped" else ():
            poses = np.empty((task.horizon, 3))
            simulate(body, pose, task.robot.motion_of[[a, *answer.witnesses[a]]], poses)
            assert margin(case.spec, [pose, *poses]) > 0.0
            certified += 1
    assert certified > 300
