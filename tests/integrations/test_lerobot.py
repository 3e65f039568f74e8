"""LeRobot's own policies inside a rule, with weights that nobody has trained. Where lerobot is installed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from specshield.integrations.samples import SampleShield
from specshield.local import LocalShield
from specshield.robot import robot_from_json
from specshield.world.occupancy import OccupancyGrid

try:
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
except (ImportError, RuntimeError) as error:  # RuntimeError: a torchvision that is not made for this torch
    pytest.skip(f"lerobot cannot be imported: {error}", allow_module_level=True)

import torch

ROBOT = robot_from_json(
    {
        "footprint": {"radius": 0.2},
        "actions": [
            {"name": "end", "terminal": True},
            {"name": "forward", "translate": 0.25},
            {"name": "left", "rotate": 0.5},
            {"name": "right", "rotate": -0.5},
        ],
    }
)
RULE = "F[0,30] Dock and G[0,40] not touches(Stairs)"
REGIONS = {
    "Dock": {"type": "circle", "center": [4.0, 4.0], "radius": 0.4},
    "Stairs": {"type": "rectangle", "min": [2.0, 1.0], "max": [3.0, 2.0]},
}


def shape() -> dict[str, Any]:
    return {
        "input_features": {
            "observation.state": PolicyFeature(FeatureType.STATE, (3,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (2,)),
        },
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (2,))},
        "device": "cpu",
    }


def act() -> Any:
    small = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 64, "n_encoder_layers": 1}
    return ACTPolicy(ACTConfig(**shape(), **small, chunk_size=4, n_action_steps=4))


def diffusion() -> Any:
    steps = {"n_obs_steps": 2, "horizon": 8, "n_action_steps": 4, "num_inference_steps": 2}
    return DiffusionPolicy(DiffusionConfig(**shape(), **steps, down_dims=(32, 64)))


@pytest.mark.parametrize("make", [act, diffusion])
@pytest.mark.parametrize("seed", range(3))
def test_a_policy_that_knows_nothing_keeps_the_rule(make: Any, seed: int) -> None:
    from specshield.integrations.lerobot import ShieldedPolicy

    torch.manual_seed(seed)
    policy = make().eval()
    grid = OccupancyGrid(np.zeros((50, 50), bool), 0.1)
    shield = LocalShield.make(grid, RULE, REGIONS, robot=ROBOT)
    pose = (1.0, 2.5, 0.0)
    session = shield.session(initial_pose=pose, seed=seed, uncertainty="none", learn_map=False)
    chooser = SampleShield(session, ROBOT, lambda seen: seen["pose"], lambda row: 0.25 * row)
    shielded = ShieldedPolicy(policy, chooser, lambda move, turn, like: np.array([move, turn]) / 0.25)
    drawn = 0
    for _ in range(shield.task.horizon):
        state, around = torch.tensor([pose]).float(), torch.zeros(1, 2)
        action = shielded.select_action(
            {"pose": pose, "observation.state": state, "observation.environment_state": around}
        )
        assert action.shape == (1, 2)
        assert action.dtype == torch.float32
        decision = shielded.decision
        drawn += sum(share > 0.0 for share in decision.distribution) > 1
        pose = decision.next_poses[decision.execute]
    assert session.close(pose).spec_status == "satisfied"
    assert (drawn > 0) == (make is diffusion), "ACT has one opinion, a Diffusion policy several"
