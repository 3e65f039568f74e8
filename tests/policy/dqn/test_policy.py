"""The files that a policy is loaded from, and what undoes a motion."""

from __future__ import annotations

import math

import pytest

from specshield.errors import PolicyError
from specshield.policy.card import policy_id
from specshield.policy.methods import load_policy
from specshield.policy.undo import undoing_motions
from specshield.robot import STRETCH, Action, Robot
from tests.policy.rooms import CUSTOM, flat, random_policy, sizes


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


def test_what_undoes_a_motion():
    assert [m for m, _ in undoing_motions(STRETCH)] == [3, 2, 1, 0, -1, 6, 5]
    assert undoing_motions(CUSTOM).tolist() == [[-1, -1], [-1, -1], [1, -1]]  # it never goes back
    moves = [(0.0, 0.0), (0.1, 0.4), (-0.1, 0.0), (0.0, -0.4), (0.0, math.pi)]
    robot = Robot(
        "arc", 0.1, (0.0, 0.0), "stop", tuple(Action(f"a{m}", *move) for m, move in enumerate(moves))
    )
    assert undoing_motions(robot).tolist() == [[-1, -1], [3, 2], [-1, -1], [-1, -1], [3, -1]]
