"""Policies that answer with samples: openpi's interface as it is, LeRobot's as recorded."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from specshield.client import LocalDecision
from specshield.errors import InputError
from specshield.integrations.samples import SampleShield, nearest_action
from specshield.local import LocalShield
from specshield.robot import STRETCH, robot_from_json
from specshield.world.occupancy import OccupancyGrid

ROBOT = robot_from_json(
    {
        "footprint": {"radius": 0.2},
        "actions": [
            {"name": "end", "terminal": True},
            {"name": "forward", "translate": 0.25},
            {"name": "left", "rotate": 0.5},
        ],
    }
)
AHEAD, LEFT = np.array([0.25, 0.0]), np.array([0.0, 0.5])


def session(rule: str) -> Any:
    shield = LocalShield.make(OccupancyGrid(np.zeros((20, 20), bool), 0.25), rule, robot=ROBOT)
    return shield.session(initial_pose=(1.0, 2.5, 0.0), uncertainty="none", learn_map=False, seed=1)


def chooser(rule: str) -> SampleShield:
    return SampleShield(session(rule), ROBOT, lambda seen: (1.0, 2.5, 0.0), lambda row: (row[0], row[1]))


def test_the_nearest_action() -> None:
    names = STRETCH.action_names
    assert names[nearest_action(STRETCH, 0.17, 0.05)] == "m"
    assert names[nearest_action(STRETCH, 0.0, 0.09)] == "ls"
    assert names[nearest_action(STRETCH, 0.0, -0.4)] == "r"
    assert names[nearest_action(STRETCH, -0.15, 0.0)] == "b"
    assert names[nearest_action(STRETCH, 0.01, 0.0)] == "sub_done"


def test_the_shares_of_the_samples_are_the_models_distribution() -> None:
    chosen = chooser("F[0,40] x > 2").choose([AHEAD, AHEAD, LEFT, AHEAD], None)
    assert chosen.decision.distribution == pytest.approx((0.0, 0.75, 0.25))
    with pytest.raises(InputError):
        chooser("F[0,40] x > 2").choose([], None)


def test_a_sample_that_would_break_the_rule_is_not_chosen() -> None:
    """Within 4 steps 4 moves of 0.25 m: not one of them can be a turn."""
    chosen = chooser("F[0,4] x > 1.9").choose([LEFT, LEFT, AHEAD, LEFT], None)
    assert (chosen.action, chosen.sample) == (1, 2)
    chosen = chooser("F[0,4] x > 1.9").choose([LEFT], None)
    assert (chosen.action, chosen.sample) == (1, None)
    assert chosen.decision.reason == "zero_prior_mass"


def test_a_sample_that_is_no_motion_is_left_out() -> None:
    for lost in (np.nan, np.inf):
        rows = [np.array([lost, 0.0]), np.array([0.0, lost]), AHEAD]
        chosen = chooser("F[0,40] x > 2").choose(rows, None)
        assert (chosen.action, chosen.sample) == (1, 2)
        assert chosen.decision.distribution[1] == 1.0
    with pytest.raises(InputError, match="finite"):
        chooser("F[0,40] x > 2").choose([AHEAD * np.nan], None)


def test_an_openpi_policy_keeps_the_rule() -> None:
    pytest.importorskip("openpi_client")
    from examples import sampled_base

    assert [sampled_base.drive(seed) for seed in range(3)] == ["satisfied"] * 3


class Recorded:
    """As lerobot's PreTrainedPolicy (0.4.4): chunks [B, horizon, D] of the policy's dtype."""

    def __init__(self, rows: list[Any]) -> None:
        self.rows, self.asked = rows, 0

    def predict_action_chunk(self, batch: dict[str, Any]) -> Any:
        import torch

        count, state = batch["observation.state"].shape
        assert state == 3
        self.asked += 1
        return torch.as_tensor(np.tile(self.rows[self.asked % len(self.rows)], (count, 50, 1))).float()

    def reset(self) -> None:
        self.asked = 0


def test_a_lerobot_policy_is_asked_for_samples_and_answers_as_before() -> None:
    torch = pytest.importorskip("torch")
    from specshield.integrations.lerobot import ShieldedPolicy

    batch = {"observation.state": torch.zeros(1, 3)}
    policy = Recorded([LEFT, AHEAD])
    shielded = ShieldedPolicy(policy, chooser("F[0,4] x > 1.9"), lambda move, turn, like: [move, turn])
    action = shielded.select_action(batch)
    assert (action.shape, action.dtype) == ((1, 2), torch.float32)
    assert action[0].numpy() == pytest.approx(AHEAD)
    assert policy.asked == 8
    only = ShieldedPolicy(Recorded([LEFT]), chooser("F[0,4] x > 1.9"), lambda move, turn, like: [move, turn])
    assert only.select_action(batch)[0].numpy() == pytest.approx(AHEAD)
    with pytest.raises(InputError, match="one observation at a time"):  # nobody would judge the second
        only.select_action({"observation.state": torch.zeros(2, 3)})
    shielded.reset()
    assert policy.asked == 0


def test_a_row_that_no_sample_gave_is_like_one_that_is_a_motion() -> None:
    """The first sample is lost: what it says of a gripper is lost with it."""
    pytest.importorskip("torch")
    from specshield.integrations.lerobot import ShieldedPolicy

    policy = Recorded([np.array([0.0, 0.5, 0.7]), np.full(3, np.nan)])
    shielded = ShieldedPolicy(
        policy, chooser("F[0,4] x > 1.9"), lambda move, turn, like: [move, turn, like[2]], samples=2
    )
    action = shielded.select_action({"observation.state": np.zeros((1, 3))})
    assert action[0].numpy() == pytest.approx([*AHEAD, 0.7])


def test_a_robot_that_has_to_stand_is_given_the_row_that_stands() -> None:
    """As the SDK's session says it, where the service is away and nothing is certified."""
    pytest.importorskip("torch")
    from specshield.integrations.lerobot import ShieldedPolicy

    class Away:
        main_task_done = False

        def step(self, pose: Any, logits: Any = None, *, main_task_done: bool | None = None) -> LocalDecision:
            return LocalDecision(0, "stop", None, "the service is away", "pending")

    shield = SampleShield(Away(), ROBOT, lambda seen: (1.0, 2.5, 0.0), lambda row: (row[0], row[1]))
    shielded = ShieldedPolicy(Recorded([AHEAD]), shield, lambda move, turn, like: [move, turn])
    action = shielded.select_action({"observation.state": np.zeros((1, 3))})
    assert action[0].tolist() == [0.0, 0.0]
    assert isinstance(shielded.decision, LocalDecision)
