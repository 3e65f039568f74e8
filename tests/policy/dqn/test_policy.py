"""What a policy sees, computes and proposes; and the files it is loaded from."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from specshield.errors import PolicyError
from specshield.policy.card import policy_id
from specshield.policy.dqn.environment import Environment, free_poses
from specshield.policy.dqn.network import greedy, make_network
from specshield.policy.dqn.observation import PER_MOTION, observation_size, observe
from specshield.policy.dqn.rollout import rollout
from specshield.policy.dqn.train import _QNetwork
from specshield.policy.methods import load_policy
from specshield.robot import STRETCH, Action, Robot
from specshield.robot.dynamics import (
    in_collision,
    make_body,
    motion_count,
    simulate,
    step,
    successors,
    undoing_motions,
)
from specshield.rule.progress import (
    BROKEN,
    SETTLED,
    STACK,
    make_rules,
    read_predicates,
    replay,
    value_count,
)
from specshield.stl import robustness
from tests.policy.rooms import CUSTOM, flat, random_policy, random_weights, sizes

BOTH = pytest.mark.parametrize("robot", [STRETCH, CUSTOM], ids=["stretch", "custom"])


@BOTH
def test_observations_are_finite_and_bounded(robot):
    task = flat(robot=robot)
    environment, random = Environment(task, 128, seed=1), np.random.default_rng(1)
    seen = np.array([np.inf, -np.inf])
    for _ in range(150):
        environment.step(random.integers(0, len(robot.motions), 128))
        observations = environment.observations
        assert np.isfinite(observations).all()
        seen = np.array([min(seen[0], observations.min()), max(seen[1], observations.max())])
    assert -2.0 <= seen[0] < seen[1] <= 2.5


def test_free_poses_are_free_and_spread():
    task = flat()
    body = make_body(task.robot, task.grid)
    poses = free_poses(task, body, 2000, np.random.default_rng(0))
    assert not any(in_collision(body, *pose) for pose in poses)
    u = task.grid.to_grid(poses[:, :2])[:, 0]
    assert 0.4 < np.mean(u < 2.0) < 0.6
    assert abs(np.mean(poses[:, 2])) < 0.2


def forward(weights, x):
    for i in (1, 2, 3):
        x = x @ weights[f"w{i}"] + weights[f"b{i}"]
        x = np.maximum(x, np.float32(0)) if i < 3 else x
    return x


def test_the_network_is_a_plain_forward_and_torch_agrees():
    task, random = flat(), np.random.default_rng(0)
    weights = random_weights(task)
    net = make_network(weights, *sizes(task))
    module = _QNetwork(sizes(task)[0], 12, sizes(task)[1])
    weights_square = random_weights(task, 1, units=(12, 12))
    module.set_weights(weights_square)
    assert all((module.weights()[n] == weights_square[n]).all() for n in weights_square)
    square = make_network(weights_square, *sizes(task))
    h = [np.empty(16, np.float32), np.empty(12, np.float32), np.empty(12, np.float32)]
    q = np.empty(sizes(task)[1], np.float32)
    for _ in range(200):
        x = random.normal(0, 1, sizes(task)[0]).astype(np.float32)
        x[random.random(len(x)) < 0.3] = 0.0
        best = greedy(net, x, h[0], h[1], q)
        expected = forward(weights, x)
        assert best == np.argmax(expected)
        np.testing.assert_allclose(q, expected, atol=1e-4)
        greedy(square, x, h[2], h[1], q)
        with torch.no_grad():
            np.testing.assert_allclose(q, module(torch.from_numpy(x)[None])[0].numpy(), atol=1e-4)
    zero = {n: np.zeros_like(a) for n, a in weights.items()}
    assert greedy(make_network(zero, *sizes(task)), x, h[0], h[1], q) == 0  # the lowest index on ties


def hostile():
    good = random_weights(flat())
    yield {**good, "w1": good["w1"].astype(np.float64)}, "weights.w1"
    yield {**good, "w1": good["w1"][:-1]}, "weights.w1"
    yield {**good, "w1": good["w1"].ravel()}, "weights.w1"
    yield {**good, "b2": good["b2"][:-1]}, "weights.b2"
    yield {**good, "w3": good["w3"][:, :-1]}, "weights.w3"
    yield {**good, "b3": np.where(np.arange(7) == 2, np.nan, good["b3"]).astype(np.float32)}, "weights.b3"
    yield {**good, "b3": np.int32([1] * 7)}, "weights.b3"
    yield {n: good[n] for n in ("w1", "b1")}, "weights"
    yield {**good, "w4": good["w3"]}, "weights"
    wide = random_weights(flat(), units=(2000, 4))
    yield wide, "weights.w1"


@pytest.mark.parametrize(("weights", "path"), list(hostile()))
def test_tensors_that_do_not_fit_are_named(weights, path):
    with pytest.raises(PolicyError) as caught:
        make_network(weights, *sizes(flat()))
    assert caught.value.path == path


@pytest.mark.parametrize(
    ("formula", "robot", "origin"),
    [
        ("F[0,9] West", STRETCH, (-1.0, 0.5, 0.3)),
        (None, CUSTOM, (-1.0, 0.5, 0.3)),
        (None, STRETCH, (0.0, 0.0, 0.0)),
    ],
)
def test_a_policy_loads_for_its_own_task_alone(formula, robot, origin):
    policy = random_policy(flat())
    weights = policy.weights()
    again = load_policy(weights, policy.card, flat())
    assert again.id == policy.id == policy_id(policy.task.content_hash, "dqn", {}, 0)
    assert all((a == b).all() for a, b in zip(again.network, policy.network, strict=True))
    other = flat(robot=robot, origin=origin) if formula is None else flat(formula)
    with pytest.raises(PolicyError) as caught:
        load_policy(weights, policy.card, other)
    assert (caught.value.path, caught.value.expected) == ("card.task_hash", other.content_hash)
    if sizes(other) != sizes(flat()):  # a forged card does not make the weights fit
        with pytest.raises(PolicyError, match="fit"):
            load_policy(weights, {**policy.card, "task_hash": other.content_hash}, other)


@pytest.mark.parametrize(
    "weights",
    [
        b"",
        b"\x80\x04pickle",
        b"\xff" * 64,
        (8).to_bytes(8, "little") + b"{}{}{}{}",
        (2**63).to_bytes(8, "little"),
    ],
)
def test_bytes_that_are_no_safetensors(weights):
    task = flat()
    card = random_policy(task).card
    with pytest.raises(PolicyError) as caught:
        load_policy(weights, card, task)
    assert caught.value.path == "weights"
    whole = random_policy(task).weights()
    for cut in (whole[:-4], whole[: len(whole) // 2], whole + b"more"):
        with pytest.raises(PolicyError):
            load_policy(cut, card, task)
    with pytest.raises(PolicyError, match="method"):
        load_policy(whole, {**card, "method": "oracle"}, task)


@BOTH
def test_proposals_never_differ(robot):
    """The rollout that certifies an action and the one taken later are the same, bit for bit."""
    task = flat(robot=robot)
    policy = random_policy(task, 3)
    body, (_, rules, sight) = make_body(robot, task.grid), policy._prepared
    history = free_poses(task, body, 1, np.random.default_rng(2))
    status, run = np.zeros(len(rules.kind), np.int8), np.zeros(len(rules.kind), np.int64)
    for t in range(12):
        proposal = policy.propose(history, {}, 0.0)
        again = random_policy(task, 3).propose(history, {}, 0.0)
        n = task.horizon - t
        assert proposal.motions.shape == (len(robot.motions), n)
        assert (proposal.motions == again.motions).all()
        assert proposal.preferred == again.preferred
        assert proposal.motions[:, 0].tolist() == list(range(len(robot.motions)))
        if t == 0:  # alone, outside the batch
            motions, poses = np.empty(n, np.int64), np.empty((n, 3))
            rollout(
                body,
                rules,
                sight,
                policy.network,
                history[-1],
                0,
                status,
                run,
                -1,
                robot.wait_motion,
                motions,
                poses,
            )
            row = motions[0]
            assert row == proposal.preferred
            assert (motions == proposal.motions[row]).all()
            exact = np.empty((n, 3))
            simulate(body, history[-1], motions, exact)
            assert (poses == exact).all()
        # The policy, one step on along its own proposal, proposes the rest of it.
        following = proposal.motions[proposal.preferred]
        history = np.vstack([history, step(body, *history[-1], proposal.preferred)])
        onward = policy.propose(history, {}, 0.0)
        assert onward.preferred == following[1]
        assert (onward.motions[onward.preferred] == following[1:]).all()


def test_what_undoes_a_motion():
    assert [m for m, _ in undoing_motions(STRETCH)] == [3, 2, 1, 0, -1, 6, 5]
    assert undoing_motions(CUSTOM).tolist() == [[-1, -1], [-1, -1], [1, -1]]  # it never goes back
    moves = [(0.0, 0.0), (0.1, 0.4), (-0.1, 0.0), (0.0, -0.4), (0.0, math.pi)]
    robot = Robot(
        "arc", 0.1, (0.0, 0.0), "stop", tuple(Action(f"a{m}", *move) for m, move in enumerate(moves))
    )
    assert undoing_motions(robot).tolist() == [[-1, -1], [3, 2], [-1, -1], [-1, -1], [3, -1]]


def led(body, pose, rows):
    """Where each row of motions leads from a pose."""
    poses = np.empty((*rows.shape, 3))
    for motions, out in zip(rows, poses, strict=True):
        simulate(body, pose, motions, out)
    return poses


def test_to_undo_a_motion_and_go_on_certifies_no_less_than_the_policy_itself():
    task = flat("F[1,12] West and G[0,12] not Hole")
    body, retraced, more = make_body(STRETCH, task.grid), 0, 0
    starts = free_poses(task, body, 400, np.random.default_rng(0))
    for i, pose in enumerate(starts[task.samples(starts)["West"] > -0.2]):
        policy = random_policy(task, i)
        literal = replace(policy, literal=True).propose(pose[None], {}, 0.0)
        proposal = policy.propose(pose[None], {}, 0.0)
        own = (proposal.motions == literal.motions).all(axis=1)
        assert proposal.preferred == literal.preferred
        assert own[proposal.preferred]
        rho = [
            robustness(task.formula, task.samples(np.insert(led(body, pose, rows.motions), 0, pose, axis=1)))
            for rows in (literal, proposal)
        ]
        assert (rho[1][~own] > 0.0).all()  # what is not the policy's own rollout satisfies
        assert (rho[1][own] == rho[0][own]).all()
        retraced, more = retraced + (~own).sum(), more + (rho[0][~own] <= 0.0).sum()
    assert retraced > 50
    assert more > 10


@BOTH
def test_what_is_seen_of_one_motion_does_not_depend_on_the_others(robot):
    """Motions share work where they can: each alone, on the same states, looks the same bit for bit."""
    task = flat("F[0,30] West and G[0,40] not Hole and G[5,40] theta < 3", robot=robot)
    body, rules, sight = random_policy(task)._prepared
    kinds, values, stack = len(rules.kind), np.empty(value_count(rules)), np.empty(STACK)
    status, run, predicates, after = (
        np.zeros(kinds, np.int8),
        np.zeros(kinds, np.int64),
        *np.empty((2, kinds)),
    )

    def seen(part, t, pose):
        nexts = np.empty((motion_count(part), 3))
        out = np.full(observation_size(rules, part), np.nan, np.float32)
        successors(part, pose, nexts)
        read_predicates(rules, *pose, values, stack, predicates)
        observe(part, rules, sight, t, pose, status, run, predicates, nexts, values, stack, after, out)
        return out

    for t, pose in enumerate(free_poses(task, body, 40, np.random.default_rng(3))):
        together = seen(body, t, pose)
        assert together.min() < 0.0
        common = len(together) - PER_MOTION * motion_count(body)
        for m in range(motion_count(body)):
            part = body._replace(translate=body.translate[m : m + 1], rotate=body.rotate[m : m + 1])
            alone = seen(part, t, pose)
            at = common + PER_MOTION * m
            assert (alone == np.delete(together, np.r_[common:at, at + PER_MOTION : len(together)])).all()


def test_a_rollout_reports_what_the_robustness_says():
    task = flat("F[1,12] West and G[0,12] not Hole")
    body, outcomes = make_body(STRETCH, task.grid), []
    status, run = np.zeros(2, np.int8), np.zeros(2, np.int64)
    motions, poses = np.empty(12, np.int64), np.empty((12, 3))
    starts = free_poses(task, body, 400, np.random.default_rng(0))
    for i, pose in enumerate(starts[task.samples(starts)["West"] > -0.2]):
        policy = random_policy(task, i)
        _, rules, sight = policy._prepared
        replay(rules, pose[None], np.empty((1, 0)), status, run)
        wait = STRETCH.wait_motion
        outcome = rollout(
            body, rules, sight, policy.network, pose, 0, status, run, i % 7, wait, motions, poses
        )
        rho = robustness(task.formula, task.samples(np.vstack([pose, poses])))
        assert outcome == (SETTLED if rho > 0 else BROKEN)
        outcomes.append(outcome)
    assert min(outcomes.count(SETTLED), outcomes.count(BROKEN)) > 10


def test_a_broken_obligation_does_not_end_what_is_pending():
    """With one goal missed for good, the rollouts still move on to the other."""
    task = flat("F[0,2] East and F[10,40] West")
    policy = random_policy(task, 1)
    history = np.tile(free_poses(task, make_body(STRETCH, task.grid), 1, np.random.default_rng(4)), (4, 1))
    assert task.samples(history)["East"].max() < 0
    wait = STRETCH.wait_motion
    assert (policy.propose(history, {}, 0.0).motions[:, 1:] != wait).any()
    broken = flat("F[0,2] East and G[0,40] not Hole")
    settled = flat("F[0,2] not Hole and F[0,40] not Hole")
    assert (random_policy(broken, 1).propose(history, {}, 0.0).motions[:, 1:] != wait).any()
    assert (random_policy(settled, 1).propose(history, {}, 0.0).motions[:, 1:] == wait).all()


def test_step_is_what_the_environment_does():
    task = flat(robot=CUSTOM)
    environment = Environment(task, 16, seed=0)
    body, before = environment.body, environment.pose.copy()
    motions = np.arange(16) % 3
    _, ended = environment.step(motions)
    for i in np.flatnonzero(~ended):
        assert tuple(environment.pose[i]) == step(body, *before[i], motions[i])
    assert (make_rules(task).last <= task.horizon).all()
