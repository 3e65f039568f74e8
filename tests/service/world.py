"""A small world whose policy the tests make themselves, sent to the server the way anybody would."""

from __future__ import annotations

import json
from typing import Any

import httpx
import msgspec
import numpy as np
from safetensors.numpy import save

from specshield.policy.card import make_card
from specshield.policy.dqn.observation import observation_size
from specshield.policy.progress import make_rules
from specshield.robot import robot_from_json
from specshield.robot.dynamics import make_body, motion_count
from specshield.service.sessions.rules import Rule
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid

HEIGHT, WIDTH, RESOLUTION = 30, 40, 0.1
ROBOT = {
    "footprint": {"radius": 0.15, "offset": [0.0, 0.0]},
    "on_contact": "stay",
    "actions": [
        {"name": "forward", "translate": 0.2},
        {"name": "left", "rotate": 0.5},
        {"name": "right", "rotate": -0.5},
        {"name": "wait"},
        {"name": "end", "terminal": True},
    ],
}
SPEC: dict[str, Any] = {
    "formula": "F[0,6] Goal and G[0,8] battery > 10",
    "regions": {"Goal": {"type": "circle", "center": [2.0, 1.5], "radius": 0.5}},
    "signals": {"battery": 90.0},
}
START = [1.0, 1.5, 0.0]  # four moves ahead of the goal's edge
LOGITS: list[float | None] = [1.0, 0.0, 0.5, -1.0, None]


def cells() -> np.ndarray:
    occupied = np.zeros((HEIGHT, WIDTH), bool)
    occupied[0] = occupied[-1] = occupied[:, 0] = occupied[:, -1] = True
    occupied[20:25, 30:35] = True
    return occupied


def grid_json() -> dict[str, Any]:
    pose = {
        "position": {"x": 0.0, "y": 0.0, "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    info = {"resolution": RESOLUTION, "width": WIDTH, "height": HEIGHT, "origin": pose}
    return {"format": "occupancy_grid", "info": info, "data": (cells() * 100).ravel().tolist()}


def policy_files(spec: dict[str, Any] = SPEC, seed: int = 0, robot: dict[str, Any] = ROBOT) -> dict[str, Any]:
    """A network of zeros: of equal actions the first is taken, so it drives forward for ever."""
    task = make_task(
        OccupancyGrid(cells(), RESOLUTION),
        robot_from_json(robot),
        spec["formula"],
        spec["regions"],
        None,
        spec.get("signals"),
    )
    body = make_body(task.robot, task.grid)
    sizes = [observation_size(make_rules(task), body), 4, 4, motion_count(body)]
    weights = {f"w{i + 1}": np.zeros((sizes[i], sizes[i + 1]), np.float32) for i in range(3)}
    weights |= {f"b{i + 1}": np.zeros(sizes[i + 1], np.float32) for i in range(3)}
    card = make_card(task, "dqn", {}, seed, {"satisfied": 1.0}, spec)
    return {"weights": save(weights), "card": json.dumps(card).encode()}


def send_policy(client: httpx.Client, **of: Any) -> dict[str, Any]:
    response = client.post("/v1/policies", files={k: (k, v) for k, v in policy_files(**of).items()})
    assert response.status_code == 202, response.text
    sent: dict[str, Any] = response.json()
    return sent


def ahead(n: int) -> list[list[float]]:
    """START and n moves forward, as f has them: x_0 .. x_n."""
    x, poses = START[0], [START]
    for _ in range(n):
        x += 0.2
        poses.append([x, 1.5, 0.0])
    return poses


def rule(**members: Any) -> Rule:
    """A session's stored rule, in which these members matter."""
    usual = Rule(
        id="a", policy_ids=[], map_id="m", spec={"formula": "F[0,6] Goal", "regions": {}, "signals": {}},
        robot="stretch", horizon=6, actions=[], terminal_actions=[], seed=0, threshold=1.0, margin=0.0,
        evaluation="feasibility", max_steps=600, shaping="projection",
    )  # fmt: skip
    return msgspec.structs.replace(usual, **members)
