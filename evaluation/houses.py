"""ProcTHOR houses as cases: a rule over named rooms, and something to find in another room."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from specshield.errors import NotFound
from specshield.robot import STRETCH
from specshield.sim.cases import REPOSITORY, Case
from specshield.task import make_task
from specshield.world.procthor import load_house
from specshield.world.regions import signed_distance

HOUSES = REPOSITORY.parent / "shared" / "data" / "houses"
RULE = "F[0,80] Kitchen and F[80,160] Bedroom and G[0,160] not Bathroom"
INSTRUCTION = "find a bowl"
RESOLUTION = 0.05  # [m]


def load_house_case(house: str, rule: str = RULE) -> Case:
    """The case of a house: a path to its JSON, with asset-sizes.json beside it, or a name in HOUSES.

    The target stands where there is most room outside the rooms that the rule names. Raises NotFound,
    FormulaError.
    """
    path = Path(house) if house.endswith(".json") else HOUSES / f"{house}.json"
    sizes = path.with_name("asset-sizes.json")
    if not (path.is_file() and sizes.is_file()):
        raise NotFound(
            "there is no such house", path="house", got=str(house),
            expected="a path to a ProcTHOR house's JSON, with asset-sizes.json beside it, or the name of one "
            "in ../shared/data/houses",
        )  # fmt: skip
    grid, rooms = load_house(json.loads(path.read_text()), json.loads(sizes.read_text()), RESOLUTION)
    task = make_task(grid, STRETCH, rule, rooms=rooms)
    outside = [-signed_distance(room, grid.centres) for room in task.regions.values()]
    roomy = np.min([grid.clearance, *outside], axis=0)
    x, y = grid.centres[np.unravel_index(np.argmax(roomy), roomy.shape)].tolist()
    return Case(path.stem, task, rooms, {"formula": rule, "regions": {}}, INSTRUCTION, (x, y))
