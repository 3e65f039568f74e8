"""Requests for the docs page. From the top of the page down each of them works as it stands."""

from __future__ import annotations

from typing import Any

SPEC_REQUEST: dict[str, Any] = {
    "formula": "F[0,60] (Charger1 or Charger2) and G[0,150] not Forbidden",
    "regions": {
        "Charger1": {"type": "circle", "center": [1.0, 2.0], "radius": 0.6},
        "Charger2": {"type": "rectangle", "min": [4.0, 1.0], "max": [5.0, 2.0]},
        "Forbidden": {"type": "polygon", "vertices": [[2.0, 2.0], [3.0, 2.0], [2.5, 3.0]]},
    },
}

POLICY: dict[str, Any] = {
    "map_id": "case1",
    "robot": "stretch",
    "spec": {
        "formula": "F[0,60] Goal",
        "regions": {"Goal": {"type": "circle", "center": [2.0, 2.0], "radius": 0.6}},
    },
    "method": "reachability",
    "seed": 0,
}

SESSION: dict[str, Any] = {"id": "example", "policy_id": "case1", "initial_pose": [5.0, 5.0, 0.0], "seed": 7}

STEP: dict[str, Any] = {
    "t": 0,
    "poses": [[5.0, 5.0, 0.0]],
    "logits": [2.0, 0.5, 0.5, -1.0, -4.0, None, 0.0, 0.0, *[None] * 12],
    "main_task_done": False,
}

SWITCH: dict[str, Any] = {"t": 1, "policy_id": "case1", "clock": "restart", "poses": [[5.2, 5.0, 0.0]]}

CLOSE: dict[str, Any] = {"t": 1, "poses": [[5.2, 5.0, 0.0]]}
