"""The paper's cases, which are read from maps/: the apartment, the rule, and what the robot has to find."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from specshield.arrays import Floats
from specshield.errors import NotFound
from specshield.policy.geodesic import geodesic_distance
from specshield.robot import STRETCH
from specshield.robot.dynamics import Body, make_body
from specshield.shipped import MAPS
from specshield.task import Task, make_task
from specshield.world.map_server import load_map
from specshield.world.regions import Region, region_from_json


@dataclass(frozen=True, eq=False)
class Case:
    """A task, its spec as JSON, and the model's instruction. target: where its object is, (x, y) [m]."""

    name: str
    task: Task
    rooms: Mapping[str, Region]
    spec: Mapping[str, Any]
    instruction: str
    target: tuple[float, float]

    @cached_property
    def body(self) -> Body:
        return make_body(self.task.robot, self.task.grid)

    @cached_property
    def distance(self) -> Floats:
        """Metres along free space from each cell to the target, inf in walls. Shape [height, width]."""
        grid = self.task.grid
        goal = np.zeros_like(grid.occupied)
        goal[self.cell(self.target)] = True
        return geodesic_distance(~grid.occupied, goal, grid.resolution)

    def cell(self, point: Sequence[float]) -> tuple[int, int]:
        """Row and column of the cell in which (x, y) lies."""
        column, row = np.floor(self.task.grid.to_grid(point[:2]) / self.task.grid.resolution).astype(int)
        return int(row), int(column)


def case_names(folder: Path = MAPS) -> list[str]:
    return sorted(path.name.removesuffix(".regions.json") for path in folder.glob("*.regions.json"))


def case_name(said: str) -> str:
    """The name of a case for its number or its name: 1 is case1, 2b is case2b."""
    return f"case{said}" if said[:1].isdigit() else said


def variants(folder: Path = MAPS) -> dict[str, str]:
    """Cases that differ from one of `case_names` only in the rule, each with the name of that case."""
    return {
        variant: name
        for name in case_names(folder)
        for variant in json.loads((folder / f"{name}.regions.json").read_text()).get("variants", {})
    }


def load_case(name: str, folder: Path = MAPS) -> Case:
    """The case of this name or number, such as case2 or 2b. Raises NotFound."""
    asked, others = case_name(name), variants(folder)
    name, names = others.get(asked, asked), [*case_names(folder), *others]
    if name not in names:
        expected = f"one of {', '.join(names)}" if names else "a folder with case1.regions.json"
        raise NotFound(f"there is no case {name!r} in {folder}", path="case", got=name, expected=expected)
    grid = load_map((folder / f"{name}.yaml").read_text(), (folder / f"{name}.pgm").read_bytes())
    beside = json.loads((folder / f"{name}.regions.json").read_text())
    rooms = {room: region_from_json(spec, f"rooms.{room}") for room, spec in beside["rooms"].items()}
    formula = beside["formula"] if asked == name else beside["variants"][asked]
    spec = {"formula": formula, "regions": beside["regions"]}
    task = make_task(grid, STRETCH, spec["formula"], spec["regions"], rooms)
    target = next(tuple(point) for name, point in beside["targets"].items() if name in beside["instruction"])
    return Case(asked, task, rooms, spec, beside["instruction"], target)
