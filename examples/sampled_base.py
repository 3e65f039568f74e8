"""A policy that answers with chunks of base commands, as pi0 does over openpi, inside a rule.

    pip install -e '.[core]' && pip install --no-deps openpi-client
    python examples/sampled_base.py            # in process: no service is needed

The policy here is a stand-in: it draws a forward speed and a turn rate at random. For the real one, replace
`Wanders` by openpi's WebsocketClientPolicy, `pose_of` by your localisation, and `command_of` and `row_of` by
what the rows of your robot mean.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from openpi_client.base_policy import BasePolicy

from specshield.integrations.openpi import ShieldedPolicy
from specshield.integrations.samples import SampleShield
from specshield.local import LocalShield
from specshield.robot import robot_from_json
from specshield.world.occupancy import OccupancyGrid

STEP = 0.5  # [s] how long a row is run
TURN = 0.5235987755982988  # [rad]
ROBOT = robot_from_json(
    {
        "footprint": {"radius": 0.2},
        "actions": [
            {"name": "forward", "translate": 0.2},
            {"name": "left", "rotate": TURN},
            {"name": "right", "rotate": -TURN},
            {"name": "wait"},
        ],
    }
)
REGIONS = {
    "Dock": {"type": "circle", "center": [3.2, 3.2], "radius": 0.5},
    "Stairs": {"type": "rectangle", "min": [1.6, 1.6], "max": [2.4, 2.4]},
}
RULE = "F[0,60] Dock and G[0,80] not touches(Stairs)"


class Wanders(BasePolicy):
    """Chunks [10, 3]: forward speed [m/s], turn rate [rad/s], gripper."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        turning = self.random.random() < 0.4
        speed, rate = (0.0, self.random.choice([-1.0, 1.0]) * TURN / STEP) if turning else (0.2 / STEP, 0.0)
        return {"actions": np.tile([speed, rate, 0.5], (10, 1))}


def command_of(row: np.ndarray) -> tuple[float, float]:
    return float(row[0]) * STEP, float(row[1]) * STEP


def row_of(translate: float, rotate: float, like: np.ndarray) -> np.ndarray:
    return np.array([translate / STEP, rotate / STEP, *like[2:]])


def drive(seed: int) -> str:
    """One episode in an empty room; what became of the rule."""
    shield = LocalShield.make(OccupancyGrid(np.zeros((40, 40), bool), 0.1), RULE, REGIONS, robot=ROBOT)
    pose = (0.8, 0.8, 0.0)
    with shield.session(initial_pose=pose, uncertainty="none", learn_map=False) as session:
        chooser = SampleShield(session, ROBOT, lambda observation: observation["pose"], command_of)
        policy = ShieldedPolicy(Wanders(seed), chooser, row_of)
        while session.spec_status == "pending":
            answer = policy.infer({"pose": pose})
            translate, rotate = command_of(answer["actions"][0])
            x, y, theta = pose  # the robot runs the row
            ahead = (x + translate * np.cos(theta), y + translate * np.sin(theta), theta + rotate)
            pose = answer["decision"].next_poses[answer["decision"].execute] if translate else ahead
    return session.spec_status


if __name__ == "__main__":
    print(f"the rule is {drive(seed=0)}")
