"""MiniGrid and BabyAI inside a rule over their rooms.

    env = shielded(gymnasium.make("BabyAI-GoToObjMazeOpen-v0"), "F[0,100] Room_0_0 and F[100,200] Room_2_2")

A cell is 1 m. x is the column, and y counts rows from the lowest, so that theta turns counter-clockwise.
`Room_c_r` is the inside of the room in column c and row r, which MiniGrid counts from the top left. The map
is the grid after `reset`: walls, things and closed doors are occupied. Actions that would change it
(`toggle`, and `drop` with something in hand) are not possible, since the shield's robot only moves and turns.
After a thing is picked up, its cell stays occupied for the shield.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from minigrid.core.actions import Actions
from minigrid.core.roomgrid import RoomGrid
from minigrid.minigrid_env import MiniGridEnv

from specshield.arrays import Bools
from specshield.client.models import Pose
from specshield.errors import InputError
from specshield.integrations.gymnasium import Environment, ShieldWrapper
from specshield.local import LocalShield
from specshield.robot import Action, Robot
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Rectangle, Region

TURNS = {"left": math.pi / 2, "right": -math.pi / 2}  # [rad]
MOVES = {"forward": 1.0}  # [m]
ROBOT = Robot(
    "minigrid",
    radius=0.3,  # [m] any radius below half a cell
    offset=(0.0, 0.0),
    on_contact="stay",
    actions=tuple(Action(a.name, MOVES.get(a.name, 0.0), TURNS.get(a.name, 0.0)) for a in Actions),
)


def shielded(
    env: Environment, rule: str, regions: Mapping[str, Any] | None = None, **options: Any
) -> ShieldWrapper:
    """`env`, a MiniGrid environment, inside a rule over its rooms and `regions`. options: of ShieldWrapper.

    Each `reset` makes a policy for its map, in some hundredths of a second. Raises InputError for another
    environment.
    """
    if not isinstance(env.unwrapped, MiniGridEnv):
        told, expected = "this is no MiniGrid environment", "one of MiniGrid or BabyAI; or ShieldWrapper"
        raise InputError(told, path="env", got=str(env), expected=expected)

    def made(env: Environment) -> LocalShield:  # check=False: random starts lie off the cells' centres
        world, rooms, pitch = grid_of(env), rooms_of(env), {"pitch": 1.0}
        return LocalShield.make(world, rule, regions, rooms=rooms, robot=ROBOT, options=pitch, check=False)

    return ShieldWrapper(env, made, pose_of, possible=possible, **options)


def pose_of(env: Environment) -> Pose:
    inner: Any = env.unwrapped
    column, row = (int(value) for value in inner.agent_pos)
    theta = math.remainder(-inner.agent_dir * math.pi / 2, 2.0 * math.pi)
    return column + 0.5, inner.height - row - 0.5, theta


def grid_of(env: Environment) -> OccupancyGrid:
    """The map, in which the cells that cannot be entered now are occupied."""
    inner: Any = env.unwrapped
    cells = [inner.grid.get(column, row) for row in range(inner.height) for column in range(inner.width)]
    occupied = np.array([cell is not None and not cell.can_overlap() for cell in cells])
    return OccupancyGrid(occupied.reshape(inner.height, inner.width)[::-1], 1.0)


def rooms_of(env: Environment) -> dict[str, Region]:
    """The rooms of a RoomGrid, without their walls; {} for other environments."""
    inner = env.unwrapped
    if not isinstance(inner, RoomGrid):
        return {}
    found: dict[str, Region] = {}
    for r, line in enumerate(inner.room_grid):
        for c, room in enumerate(line):
            (left, top), (width, height) = room.top, room.size
            low = (left + 1.0, inner.height - (top + height - 1.0))
            high = (left + width - 1.0, inner.height - (top + 1.0))
            found[f"Room_{c}_{r}"] = Rectangle(low, high)
    return found


def possible(env: Environment) -> Bools:
    """Booleans [7]: the actions that do not change the map."""
    inner: Any = env.unwrapped
    allowed = np.ones(len(Actions), bool)
    allowed[Actions.toggle] = inner.grid.get(*inner.front_pos) is None
    allowed[Actions.drop] = inner.carrying is None
    return allowed
