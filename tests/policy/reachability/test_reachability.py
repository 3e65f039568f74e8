"""Reachability: the exact feasible set where every future can be tried, and what is refused."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import load, save

from specshield.episode import decide, make_shield, start
from specshield.errors import FragmentError, PolicyError
from specshield.policy.methods import load_policy
from specshield.policy.reachability.policy import Settings, check, synthesise
from specshield.policy.reachability.tables import LATE
from specshield.robot import STRETCH, robot_from_json
from specshield.robot.dynamics import make_body, simulate
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.cells import MOTIONS, ROBOT, WAIT, Cells

WORLDS = {
    "in turn, with a forbidden cell": Cells(
        "F[0,4] A and F[4,7] B and G[0,7] not C",
        lambda s: s["A"][..., :5].any(-1) & s["B"][..., 4:].any(-1) & ~s["C"].any(-1),
        {"A": (1, 0), "B": (0, 1), "C": (0, 2)},
    ),
    "overlapping windows, in either order": Cells(
        "F[1,5] A and F[2,7] B",
        lambda s: s["A"][..., 1:6].any(-1) & s["B"][..., 2:].any(-1),
        {"A": (0, 0), "B": (0, 2)},
    ),
    "one visit that serves two": Cells(
        "F[0,4] (A or B) and F[4,7] A",
        lambda s: (s["A"] | s["B"])[..., :5].any(-1) & s["A"][..., 4:].any(-1),
        {"A": (2, 0), "B": (0, 2)},
    ),
    "a dwell, then away": Cells(
        "F[1,3] G[1,3] A and F[6,7] B",
        lambda s: (
            np.any([s["A"][..., k + 1 : k + 4].all(-1) for k in range(1, 4)], axis=0)
            & s["B"][..., 6:].any(-1)
        ),
        {"A": (2, 2), "B": (2, 1)},
    ),
    "an always that begins late, and one that ends": Cells(
        "F[0,7] A and G[0,3] not C and G[4,6] not B",
        lambda s: s["A"].any(-1) & ~s["C"][..., :4].any(-1) & ~s["B"][..., 4:7].any(-1),
        {"A": (2, 2), "B": (2, 1), "C": (0, 2)},
    ),
    "a dwell while another always begins": Cells(
        "F[1,3] G[1,3] A and G[5,7] not A",
        lambda s: (
            np.any([s["A"][..., k + 1 : k + 4].all(-1) for k in range(1, 2)], axis=0)
            & ~s["A"][..., 5:].any(-1)
        ),
        {"A": (2, 2)},
    ),
    "a dwell that serves a visit too": Cells(
        "F[0,3] G[0,3] (A or B) and F[2,5] A",
        lambda s: (
            np.any([(s["A"] | s["B"])[..., k : k + 4].all(-1) for k in range(4)], axis=0)
            & s["A"][..., 2:6].any(-1)
        ),
        {"A": (2, 2), "B": (2, 0)},
    ),
}

ALONE = {
    "overlapping windows, in either order": [
        lambda s: s["A"][..., 1:6].any(-1),
        lambda s: s["B"][..., 2:].any(-1),
    ],
    "one visit that serves two": [
        lambda s: (s["A"] | s["B"])[..., :5].any(-1),
        lambda s: s["A"][..., 4:].any(-1),
    ],
    "a dwell while another always begins": [
        lambda s: np.any([s["A"][..., k + 1 : k + 4].all(-1) for k in range(1, 4)], axis=0),
        lambda s: ~s["A"][..., 5:].any(-1),
    ],
}
"""What each conjunct of a world asks for by itself."""

RESTLESS = replace(ROBOT, name="restless", actions=ROBOT.actions[:WAIT])


@pytest.mark.parametrize("cells", WORLDS.values(), ids=list(WORLDS))
def test_s_t_is_the_exact_feasible_set_where_it_can_be_enumerated(cells):
    """On a lattice that f never leaves, every pose at every step of random ways: none claimed falsely, none
    missed.
    """
    shield = make_shield([synthesise(cells.task, Settings(pitch=0.2))])
    random, seen = np.random.default_rng(2), set()
    for i, j, heading in [(i, j, h) for i, j in ((0, 0), (0, 1), (2, 1), (2, 2), (4, 2)) for h in range(4)]:
        history, carry = [cells.pose(i, j, heading)], None
        for _ in range(cells.task.horizon):
            expected = cells.feasible(history)
            decision = decide(shield, history, np.zeros(5), carry=carry)
            if decision.mode in ("shaped", "fallback"):
                assert decision.j_values[:MOTIONS] == tuple(expected.astype(float))
                seen.add(tuple(expected))
            likely = (
                np.flatnonzero(expected) if expected.any() and random.random() < 0.8 else np.arange(MOTIONS)
            )
            motion = int(random.choice(likely))
            history, carry = [*history, decision.next_poses[motion]], decision.carry
    assert len(seen) > 3


@pytest.mark.parametrize("world", ALONE)
def test_what_each_conjunct_has_a_future_for_need_not_have_one_for_all(world):
    """Reasoning conjunct by conjunct claims pairs that no single future keeps; S_t has none of them."""
    cells = WORLDS[world]
    alone = [Cells(cells.formula, keeps, cells.regions) for keeps in ALONE[world]]
    shield = make_shield([synthesise(cells.task, Settings(pitch=0.2))])
    random, claimed = np.random.default_rng(4), 0
    for i, j, heading in [(i, j, h) for i, j in ((0, 0), (0, 1), (2, 1), (2, 2), (4, 2)) for h in range(4)]:
        history = [cells.pose(i, j, heading)]
        for _ in range(cells.task.horizon):
            decision = decide(shield, history, np.zeros(5))
            if decision.mode not in ("shaped", "fallback"):
                break
            one_by_one = np.all([each.feasible(history) for each in alone], axis=0)
            wrong = one_by_one & ~cells.feasible(history)
            claimed += int(wrong.sum())
            assert not np.array(decision.j_values[:MOTIONS])[wrong].any()
            likely = np.flatnonzero(one_by_one) if one_by_one.any() else np.arange(MOTIONS)
            history.append(decision.next_poses[int(random.choice(likely))])
    assert claimed > 0


@pytest.mark.parametrize("cells", WORLDS.values(), ids=list(WORLDS))
def test_a_robot_that_cannot_wait_has_its_exact_feasible_set_too(cells):
    """The same worlds without the motion that waits: tables step by step, all futures tried without it."""
    task = replace(cells.task, robot=RESTLESS)
    shield = make_shield([synthesise(task, Settings(pitch=0.2))])
    random, seen = np.random.default_rng(3), set()
    for i, j, heading in [(i, j, h) for i, j in ((0, 0), (2, 1), (2, 2), (4, 2)) for h in range(4)]:
        history = [cells.pose(i, j, heading)]
        for _ in range(task.horizon):
            motions, kept = cells.futures(history)
            kept &= (motions != WAIT).all(axis=1)
            expected = np.array([kept[motions[:, 0] == m].any() for m in range(WAIT)])
            decision = decide(shield, history, np.zeros(WAIT))
            if decision.mode in ("shaped", "fallback"):
                assert decision.j_values == tuple(expected.astype(float))
                seen.add(tuple(expected))
            motion = int(random.choice(np.flatnonzero(expected) if expected.any() else WAIT))
            history.append(decision.next_poses[motion])
    assert len(seen) > 3


def test_a_robot_that_fits_nowhere_can_start_nowhere():
    cannot_wait = {"actions": [{"name": "go", "translate": 0.2}, {"name": "left", "rotate": 0.5}]}
    for robot in (STRETCH, robot_from_json({"footprint": {"radius": 1.0}, **cannot_wait})):
        grid = OccupancyGrid(np.ones((12, 12), bool) if robot is STRETCH else np.zeros((12, 12), bool), 0.1)
        policy = synthesise(make_task(grid, robot, "F[0,9] x > 0.5"))
        assert policy.card["metrics"]["feasible_start"] == 0.0


def test_a_policy_comes_back_from_its_files_as_it_was():
    task = WORLDS["in turn, with a forbidden cell"].task
    restless = synthesise(replace(task, robot=RESTLESS), Settings(pitch=0.2))
    again = load_policy(restless.weights(), restless.card, restless.task)
    np.testing.assert_array_equal(again.tables.bits, restless.tables.bits)
    policy = synthesise(task, Settings(pitch=0.2))
    history = np.array([[0.1, 0.1, 0.0]])
    again = load_policy(policy.weights(), policy.card, task)
    ours, theirs = policy.propose(history, {}, 0.0), again.propose(history, {}, 0.0)
    np.testing.assert_array_equal(ours.motions, theirs.motions)
    assert again.tables.late == policy.tables.late
    assert synthesise(task, Settings(pitch=0.2)).weights() == policy.weights()
    assert policy.id != synthesise(task, Settings(pitch=0.1)).id
    for options in ({"pitch": 0.1}, {"pitch": 0.2, "beam": 0}, {"pitch": "fine"}):
        with pytest.raises(PolicyError):
            load_policy(policy.weights(), {**policy.card, "options": options}, task)
    with pytest.raises(PolicyError, match="safetensors"):
        load_policy(policy.weights()[:-9], policy.card, task)
    for theirs in (policy.weights(), save({"cell": again.tables.cell, "bits": again.tables.bits[1:]})):
        with pytest.raises(PolicyError) as caught:
            load_policy(theirs, restless.card, restless.task)
        assert caught.value.path.startswith("weights")
    cell = restless.tables.cell.copy()
    cell[0, 0] += 1000
    with pytest.raises(PolicyError, match="fit"):
        load_policy(save({"cell": cell, "bits": again.tables.bits}), restless.card, restless.task)
    tensors = load(policy.weights())
    for late in ([-1e9], [0.0], [float("nan")], [-3.0, -3.0]):
        with pytest.raises(PolicyError) as caught:
            load_policy(save({**tensors, "late": np.array(late)}), policy.card, task)
        assert caught.value.path == "weights.late"
    del tensors["late"]  # as version 0.1.0 wrote it
    assert load_policy(save(tensors), policy.card, task).tables.late == LATE


def test_a_visit_is_no_graze_where_there_is_time():
    """In an empty room, to a circle of 0.5 m: a deadline far away buys depth, a near one is kept as it is."""
    regions = {"A": {"type": "circle", "center": [3.0, 1.5], "radius": 0.5}}
    grid, pose = OccupancyGrid(np.zeros((30, 40), bool), 0.1), np.array([[0.5, 1.5, 0.0]])
    for deadline, depth in ((40, 0.2), (15, 0.0)):
        task = make_task(grid, STRETCH, f"F[0,{deadline}] A", regions)
        found = synthesise(task).propose(pose, {}, 0.0)
        body, poses = make_body(STRETCH, grid), np.empty((*found.motions.shape, 3))
        for motions, way in zip(found.motions, poses, strict=True):
            simulate(body, pose[0], motions, way)
        assert task.samples(poses)["A"].max(axis=1).min() > depth


def test_what_the_tables_do_not_cover_is_refused():
    regions = {"A": {"type": "circle", "center": [0.5, 0.5], "radius": 0.2}}
    grid = OccupancyGrid(np.zeros((20, 20), bool), 0.1)
    with pytest.raises(FragmentError, match="too many"):
        synthesise(make_task(grid, STRETCH, " and ".join(f"F[0,{k}] A" for k in range(1, 10)), regions))
    huge = make_task(OccupancyGrid(np.zeros((1000, 1000), bool), 0.05), STRETCH, "F[0,900] A", regions)
    with pytest.raises(PolicyError, match="too large") as refused:
        check(huge, Settings(pitch=0.02))
    would = float(re.findall(r"options.pitch ([0-9.]+) or more", str(refused.value))[0])
    check(huge, Settings(pitch=would))  # what the message says would do does


def test_a_large_floor_costs_what_the_rule_can_reach():
    """40 x 40 m. A lies in a corner: the lattice covers where the robot can come from in time, no more."""
    regions = {"A": {"type": "circle", "center": [1.0, 1.0], "radius": 0.5}}
    floor = OccupancyGrid(np.zeros((800, 800), bool), 0.05)
    policy = synthesise(make_task(floor, STRETCH, "F[0,20] A", regions))
    assert policy.tables.pitch == 0.1
    assert policy.card["metrics"]["size_bytes"] < 3_000_000
    shield = make_shield([policy])
    start(shield, (2.0, 3.0, -2.0))
    again = load_policy(policy.weights(), policy.card, policy.task)
    assert again.tables.pitch == policy.tables.pitch
    whole = synthesise(make_task(floor, STRETCH, "F[0,300] A", regions))
    assert 0.1 < whole.tables.pitch <= 0.2
    assert load_policy(whole.weights(), whole.card, whole.task).tables.pitch == whole.tables.pitch


def test_turns_that_do_not_divide_the_circle_fit_a_flat():
    """10 x 10 m, 150 steps, no wait: 72 headings would not fit; 25 are as near to turns of 0.5 rad."""
    moves = [{"name": "go", "translate": 0.25}, {"name": "left", "rotate": 0.5}]
    robot = robot_from_json(
        {"footprint": {"radius": 0.2}, "actions": [*moves, {"name": "r", "rotate": -0.5}]}
    )
    regions = {"A": {"type": "circle", "center": [8.0, 8.0], "radius": 0.5}}
    grid = OccupancyGrid(np.zeros((100, 100), bool), 0.1)
    policy = synthesise(make_task(grid, robot, "F[0,150] A", regions))
    assert policy.tables.bits.shape[2] == 25
    start(make_shield([policy]), (1.0, 1.0, -2.0))


def test_a_policy_that_is_asked_briefly_proposes_the_way_that_it_would_go_and_nothing_else():
    """Rows that no way was written into held whatever was in memory, and the shield then refused them all."""
    grid, goal = OccupancyGrid(np.zeros((20, 80), bool), 0.05), {"type": "circle", "center": [3.5, 0.5]}
    task = make_task(grid, STRETCH, "F[0,30] Goal", {"Goal": goal | {"radius": 0.4}})
    proposal = synthesise(task, Settings(pitch=0.1)).briefly().propose(np.array([(0.6, 0.5, 0.0)]), {}, 0.0)
    assert proposal.motions[:, 0].tolist() == [proposal.preferred]


@pytest.mark.parametrize(
    ("formula", "radius", "x", "cells"),
    [("F[0,12] Goal", 0.03, 7.0, 180), ("G[0,30] not Start and F[0,20] Goal", 0.4, 2.8, 80)],
)
def test_a_policy_that_is_asked_briefly_hands_over_no_memory(formula, radius, x, cells, monkeypatch):
    """Where its lattice hardly sees a goal that is too far away; and where it proposes two ways, one by the
    margin and one without it.
    """
    circle = {"type": "circle", "radius": radius}
    regions = {"Start": circle | {"center": [1.0, 0.5]}, "Goal": circle | {"center": [3.5, 0.5]}}
    task = make_task(OccupancyGrid(np.zeros((20, cells), bool), 0.05), STRETCH, formula, regions)
    policy = synthesise(task, Settings(pitch=0.1)).briefly()
    history = np.tile((x, 0.5, 0.0), (3, 1))
    simulate(make_body(STRETCH, task.grid), history[0], np.zeros(2, np.int64), history[1:])
    monkeypatch.setattr(np, "empty", lambda shape, dtype=float: np.full(shape, -1, dtype))
    assert policy.propose(history, {}, 0.2).motions.min() >= 0
