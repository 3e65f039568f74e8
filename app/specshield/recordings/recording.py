"""A session in the form from which files are written: the robot's poses, the decisions, and the map."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from specshield.arrays import Floats
from specshield.client.models import TrajectoryItem
from specshield.drawing.outline import way_ahead
from specshield.errors import InputError
from specshield.robot import Robot, robot_from_json
from specshield.task import parse_regions
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Region

if TYPE_CHECKING:
    from specshield.client import ShieldClient
    from specshield.service.sessions.chain import Chain

PIECE = 100  # [steps] of the way driven that each step writes again: with all of it, files grew too large


@dataclass(frozen=True)
class Recording:
    """items: one for each step, x_0 first. grid, robot: None if they are not available; ways ahead are not
    drawn then. begun: the time of x_0 [s since 1970]. step_seconds: the duration of a step [s].
    """

    id: str
    formula: str
    actions: Sequence[str]
    regions: Mapping[str, Region]
    items: Sequence[TrajectoryItem]
    grid: OccupancyGrid | None = None
    robot: Robot | None = None
    begun: float = 0.0
    step_seconds: float = 1.0

    def seconds(self, t: int) -> float:
        """The time of step t [s since 1970]."""
        return self.begun + t * self.step_seconds

    def driven(self, first: int, last: int) -> Floats:
        """The points [n, 2] at which the robot was from step `first`, at least 0, to step `last`."""
        return np.array([item.pose[:2] for item in self.items[max(0, first) : last + 1]])

    def ahead(self, t: int) -> Floats:
        """The certified continuation at step t, as poses [n, 3] from x_t on; only x_t if there is none."""
        pose, told = self.items[t].pose, self.items[t].decision
        if told is None or self.grid is None or self.robot is None:
            return np.array([pose])
        taken = told["action"], told.get("completion_action"), told.get("witness")
        return way_ahead(self.grid, self.robot, pose, *taken)


def of_record(
    chain: Chain, grid: OccupancyGrid | None, rooms: Mapping[str, Region], step_seconds: float
) -> Recording:
    """The recording that a session's record holds (`GET /v1/sessions/{id}/record`).

    grid, rooms: of its map, None and {} if that is not available. Raises InputError after a switch.
    """
    from specshield.service.schemas.answers import to_json
    from specshield.service.sessions import record

    if len(chain.configs) > 1:
        raise InputError(
            "the session had several rules, and a file can have only one",
            got=len(chain.configs),
            expected="a session without a switch",
        )
    config, names = chain.configs[0], chain.names[0]
    begun = datetime.fromisoformat(config.created_at).timestamp() if config.created_at else 0.0
    items = []
    for t, row in enumerate(chain.rows):
        content = chain.steps[t] if t < len(chain.steps) else b""
        held = row.tolist()
        told = to_json(record.answer(record.decode(content), row, config.actions)) if content else b"null"
        pose = (held[0], held[1], held[2])
        items.append(TrajectoryItem(t, pose, dict(zip(names, held[3:], strict=True)), json.loads(told)))
    return Recording(
        config.id,
        config.spec["formula"],
        config.actions,
        {**rooms, **parse_regions(config.spec["regions"])},
        items,
        grid,
        robot_from_json(config.robot),
        begun,
        step_seconds,
    )


def map_of_service(client: ShieldClient, map_id: str) -> tuple[OccupancyGrid, Mapping[str, Region]]:
    """A server's map, read from its description and its picture: black is occupied, row 0 the highest y."""
    about = client.maps.get(map_id)
    pixels = np.asarray(Image.open(io.BytesIO(client.maps.image(map_id))).convert("L"))
    return OccupancyGrid(pixels[::-1] < 128, about.resolution, about.origin), parse_regions(dict(about.rooms))
