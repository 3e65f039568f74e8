"""The search for a way around: what it has come to is told from what is new, however much is turned away."""

from dataclasses import replace

import numpy as np

from specshield.policy.heap import Heap
from specshield.policy.reachability.around import Tree, _slot_of
from specshield.policy.reachability.policy import synthesise
from specshield.robot.barred import in_vain
from specshield.robot.dynamics import make_body, simulate
from specshield.stl import robustness
from tests.policy.rooms import flat


def empty(rows):
    ints = (np.zeros(rows, np.int32) for _ in range(3))
    heap = Heap(np.empty(rows, np.int32), np.empty(rows))
    return Tree(
        np.zeros((rows, 3)),
        np.zeros((rows, 1), np.int8),
        np.zeros((rows, 1), np.int64),
        *ints,
        np.zeros(rows),
        heap,
    )


def test_poses_that_are_turned_away_take_no_room_and_hide_nothing():
    random, rows = np.random.default_rng(0), 512
    tree, seen, count = empty(rows + 1), np.full(4 * rows, -1, np.int32), 0
    kept = []
    for _ in range(20 * rows):  # ten times what the table holds
        pose = random.uniform(0.0, 20.0, 3)
        tree.pose[count] = pose
        slot = _slot_of(tree, count, seen)
        if slot < 0:
            continue
        assert seen[slot] == count
        if random.random() < 0.9 or count == rows:
            seen[slot] = -1
        else:
            kept.append(pose)
            count += 1
    assert count > rows / 2
    assert (seen >= 0).sum() == count
    for pose in kept:  # none of those that were kept is new
        tree.pose[count] = pose
        assert _slot_of(tree, count, seen) < 0


def test_where_a_search_on_one_of_several_maps_gives_up_nothing_else_is_tried():
    """The tables know of a door to the goal, and the map has none."""
    task = flat("F[0,60] East")
    sealed = task.grid.occupied.copy()
    sealed[:, 20] = True
    body, policy = make_body(task.robot, replace(task.grid, occupied=sealed)), synthesise(task)
    history = np.array([[*task.grid.to_map([0.7, 1.5]), 0.0]])
    whole, quick = (policy.on_body(body, guess).propose(history, {}, 0.0) for guess in (False, True))
    assert (quick.motions[:, 1:] == task.robot.wait_motion).all()
    assert (whole.motions[:, 1:] != task.robot.wait_motion).any()


def test_a_way_is_found_without_the_motions_that_led_nowhere():
    """From the start, nothing leads straight ahead, nor backwards, whatever the tables say."""
    task = flat("F[0,60] East")
    policy, body = synthesise(task), make_body(task.robot, task.grid)
    history = np.array([[*task.grid.to_map([0.7, 1.5]), 0.0]])
    moves = [m for m, (far, _) in enumerate(task.robot.motions) if far]
    barred = np.array([[*history[0], m, 0.01, 0.01] for m in moves])
    ways = policy.avoiding(barred).propose(history, {}, 0.0)
    poses = np.empty((*ways.motions.shape, 3))
    for motions, led in zip(ways.motions, poses, strict=True):
        simulate(body, history[0], motions, led)
    free = ~in_vain(barred, history[0], ways.motions, poses, True)
    kept = [robustness(task.formula, task.samples(np.concatenate([history, led]))) > 0 for led in poses[free]]
    assert any(kept)
