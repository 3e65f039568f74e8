"""Houses as cases: a rule over named rooms, and something to find in another room.

`drawn_N` is a floor plan of our own making, drawn with the seed N (model/floor_plans.py), 7.5 to 12 m wide
and deep; `large_N` is one of 15 x 12 m, with more rooms than the learned models practised in. Real ones are
ProcTHOR houses in a folder of the user's: each house a JSON file, and beside them asset-sizes.json, which
maps each assetId to {"size": [x, y, z]}, its full extents in metres. Both are public: the houses are in
ProcTHOR-10K, the extents in procthor/databases/asset-database.json of github.com/allenai/procthor.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from scipy.ndimage import label

from evaluation.model.floor_plans import House, random_house
from specshield.errors import NotFound
from specshield.robot import STRETCH
from specshield.sim.cases import Case
from specshield.sim.robot import COMFORT
from specshield.task import make_task
from specshield.world.procthor import load_house
from specshield.world.regions import Polygon, Region, Union, signed_distance

RULE = "F[0,80] Kitchen and F[80,160] Bedroom and G[0,160] not Bathroom"
SPEC = {"formula": RULE, "regions": {}}
NAMED = {"Kitchen", "Bedroom", "Bathroom"}  # by the rule
DRAWN = re.compile(r"(drawn|large)_(\d+)")
LARGE = (15.0, 12.0, 10)  # [m], [m], rooms: of `large_N`
RESOLUTION = 0.05  # [m] of a ProcTHOR house's map
OTHERS = (
    2**31 + 1
)  # beside the seed: the draws of training begin with a small number alone, and share no house
SIZES = "asset-sizes.json"  # beside the houses
TO_FIND = "remote"  # in a drawn house: it lies beside a sofa, in none of NAMED


def located(house: str | None, folder: Path | None) -> str | None:
    """A house as experiments name it: drawn_N, or the path of its JSON file in `folder`."""
    if house is None or folder is None or DRAWN.fullmatch(house):
        return house
    return str(folder / f"{house}.json")


def houses_in(folder: Path) -> list[str]:
    """The paths of the houses in a folder, by name; none where there is no such folder."""
    found = sorted(path for path in folder.glob("*.json") if path.name != SIZES)
    return [str(path) for path in found]


def load_house_case(house: str) -> Case:
    """The case of a house: drawn_N, or the path of a ProcTHOR house's JSON. Raises NotFound, FormulaError."""
    drawn = DRAWN.fullmatch(house)
    if drawn:
        return _drawn_case(house, int(drawn[2]), LARGE if drawn[1] == "large" else None)
    path = Path(house)
    sizes = path.with_name(SIZES)
    if not (path.suffix == ".json" and path.is_file() and sizes.is_file()):
        raise NotFound(
            f"there is no house {house!r}", path="house", got=house,
            expected="drawn_0, drawn_1, ...; or, for a ProcTHOR house, --houses FOLDER and the name of a "
            "JSON file in it, with asset-sizes.json beside it. ProcTHOR-10K has such houses: pip install "
            'prior, then prior.load_dataset("procthor-10k"); evaluation/houses.py says what the sizes are',
        )  # fmt: skip
    grid, rooms = load_house(json.loads(path.read_text()), json.loads(sizes.read_text()), RESOLUTION)
    task = make_task(grid, STRETCH, RULE, rooms=rooms)
    outside = [-signed_distance(room, grid.centres) for room in task.regions.values()]
    roomy = np.min([grid.clearance, *outside], axis=0)  # the file does not say where a bowl is
    x, y = grid.centres[np.unravel_index(np.argmax(roomy), roomy.shape)].tolist()
    return Case(path.stem, task, rooms, SPEC, "find a bowl", (x, y))


def _drawn_case(name: str, seed: int, size: tuple[float, float, int] | None) -> Case:
    """The first house drawn with this seed in which rule and task can both be done. size: as LARGE."""
    random = np.random.default_rng([OTHERS, seed])
    while True:
        house = random_house(random, size)
        if TO_FIND in house.targets and set(house.kinds) >= NAMED:
            rooms = _rooms(house)
            task = make_task(house.grid, STRETCH, RULE, rooms=rooms)
            case = Case(name, task, rooms, SPEC, f"find a {TO_FIND}", house.targets[TO_FIND])
            if _can_be_kept(case):
                return case


def _rooms(house: House) -> dict[str, Region]:
    """The rooms by what they are; those of one kind are one region."""
    rooms: dict[str, Region] = {}
    for kind in dict.fromkeys(house.kinds):
        outlines = tuple(
            Polygon(((x0, y0), (x1, y0), (x1, y1), (x0, y1)))
            for (x0, y0, x1, y1), own in zip(house.rooms, house.kinds, strict=True)
            if own == kind
        )
        rooms[kind] = outlines[0] if len(outlines) == 1 else Union(outlines)
    return rooms


def _can_be_kept(case: Case) -> bool:
    """Whether kitchen, bedroom and target are joined by free space outside the bathroom."""
    grid = case.task.grid
    inside = {name: signed_distance(case.rooms[name], grid.centres) > 0.0 for name in NAMED}
    pieces, _ = label((grid.clearance > COMFORT) & ~inside["Bathroom"])
    piece = pieces == pieces[case.cell(case.target)]
    return bool((piece & inside["Kitchen"]).any() and (piece & inside["Bedroom"]).any())
