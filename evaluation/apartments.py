"""The two apartments of the paper's cases, as data, and the files in maps/ that are drawn from it.

Metres; each apartment's lower-left corner is (0, 0). Walls run along the axes and are WALL thick, the outer
ones inside the size. Regions and targets lie where a robot that only seeks its target breaks the rule: the
chargers off the ways to the bowl, Forbidden across the doorway that most ways to the pan lead through.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from specshield.world.map_server import dump_map
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Circle, Polygon, Rectangle, Region, region_to_json

RESOLUTION = 0.05
WALL = 0.1

Box = tuple[float, float, float, float]  # xmin, ymin, xmax, ymax


@dataclass(frozen=True)
class Apartment:
    """walls: centre lines (x0, y0, x1, y1); doors: the stretches of them that are open, likewise.

    rooms, furniture: boxes. targets: what the robot may be sent to find, each at (x, y) in free space.
    variants: cases that differ in their formula alone, by name.
    """

    name: str
    size: tuple[float, float]
    walls: tuple[Box, ...]
    doors: tuple[Box, ...]
    furniture: tuple[Box, ...]
    rooms: Mapping[str, Box]
    regions: Mapping[str, Region]
    targets: Mapping[str, tuple[float, float]]
    formula: str
    instruction: str
    variants: Mapping[str, str] = field(default_factory=dict)


CASE1 = Apartment(
    name="case1",
    size=(10.0, 10.0),
    walls=(
        (0.0, 4.2, 10.0, 4.2),
        (0.0, 5.8, 10.0, 5.8),
        (5.4, 0.0, 5.4, 4.2),
        (3.8, 5.8, 3.8, 10.0),
        (6.0, 5.8, 6.0, 10.0),
    ),
    doors=(
        (2.4, 4.2, 3.4, 4.2),  # living room, hall
        (6.9, 4.2, 7.9, 4.2),  # kitchen, hall
        (5.4, 1.0, 5.4, 2.0),  # living room, kitchen
        (2.4, 5.8, 3.4, 5.8),  # bedroom, hall
        (4.4, 5.8, 5.4, 5.8),  # bathroom, hall
        (3.8, 7.6, 3.8, 8.5),  # bedroom, bathroom
        (6.5, 5.8, 7.5, 5.8),  # office, hall
    ),
    furniture=(
        (0.1, 1.0, 1.0, 3.2),  # sofa
        (1.8, 1.3, 2.6, 2.5),  # low table
        (3.9, 3.65, 5.35, 4.15),  # sideboard
        (5.45, 0.1, 9.9, 0.7),  # counter
        (9.3, 0.7, 9.9, 4.15),  # counter
        (6.9, 1.9, 8.1, 2.7),  # kitchen table
        (0.1, 7.2, 2.2, 9.0),  # bed
        (0.1, 9.4, 1.6, 9.9),  # wardrobe
        (3.85, 9.1, 5.95, 9.9),  # bath
        (5.45, 6.5, 5.95, 7.2),  # basin
        (7.4, 9.1, 9.2, 9.9),  # desk
        (6.05, 8.2, 6.45, 9.9),  # shelves
        (8.3, 7.6, 9.1, 8.2),  # chair
    ),
    rooms={
        "LivingRoom": (0.0, 0.0, 5.4, 4.2),
        "Kitchen": (5.4, 0.0, 10.0, 4.2),
        "Hall": (0.0, 4.2, 10.0, 5.8),
        "Bedroom": (0.0, 5.8, 3.8, 10.0),
        "Bathroom": (3.8, 5.8, 6.0, 10.0),
        "Office": (6.0, 5.8, 10.0, 10.0),
    },
    regions={"Charger1": Circle((0.9, 5.0), 0.6), "Charger2": Circle((9.1, 6.6), 0.6)},
    targets={"bowl": (8.7, 1.3)},
    formula="F[0,60] (Charger1 or Charger2) and F[80,140] (Charger1 or Charger2)",
    instruction="find a bowl",
)

CASE2 = Apartment(
    name="case2",
    size=(9.7, 9.4),
    walls=((0.0, 3.4, 6.6, 3.4), (6.6, 0.0, 6.6, 6.0), (3.4, 6.0, 9.7, 6.0), (3.4, 3.4, 3.4, 9.4)),
    doors=(
        (4.6, 3.4, 5.6, 3.4),  # living room, hall
        (6.6, 4.2, 6.6, 5.2),  # kitchen, hall
        (4.4, 6.0, 5.4, 6.0),  # office, hall
        (3.4, 4.2, 3.4, 5.2),  # bedroom, hall
        (6.6, 1.3, 6.6, 2.3),  # living room, kitchen
        (7.4, 6.0, 8.4, 6.0),  # kitchen, office
        (3.4, 7.2, 3.4, 8.2),  # office, bedroom
        (1.4, 3.4, 2.4, 3.4),  # bedroom, living room
    ),
    furniture=(
        (0.1, 0.1, 0.9, 2.3),  # sofa
        (1.9, 0.1, 3.4, 0.5),  # television bench
        (3.0, 1.5, 4.2, 2.2),  # dining table
        (9.0, 0.1, 9.6, 4.4),  # counter
        (7.8, 0.1, 9.0, 0.7),  # counter
        (0.1, 7.4, 2.1, 9.3),  # bed
        (0.1, 3.45, 0.6, 4.7),  # wardrobe
        (6.4, 8.5, 8.0, 9.3),  # desk
        (9.1, 6.05, 9.6, 9.3),  # shelves
        (3.45, 8.7, 5.0, 9.3),  # cupboard
    ),
    rooms={
        "LivingRoom": (0.0, 0.0, 6.6, 3.4),
        "Kitchen": (6.6, 0.0, 9.7, 6.0),
        "Office": (3.4, 6.0, 9.7, 9.4),
        "Bedroom": (0.0, 3.4, 3.4, 9.4),
        "Hall": (3.4, 3.4, 6.6, 6.0),
    },
    regions={
        "Region1": Circle((5.0, 4.7), 0.6),
        "Region2": Circle((1.5, 5.9), 0.6),
        "Region3": Circle((5.5, 7.4), 0.6),
        "Forbidden": Rectangle((6.2, 4.1), (7.1, 5.3)),
    },
    targets={"pan": (8.0, 4.9)},
    formula="F[0,50] Region1 and F[50,100] Region2 and F[100,150] Region3 and G[0,150] not Forbidden",
    instruction="find a pan",
    variants={
        "case2b": "F[0,50] Region1 and F[50,100] Region2 and F[100,150] Region3"
        " and G[0,150] not touches(Forbidden)"  # no part of the body, not the origin alone
    },
)

APARTMENTS = {apartment.name: apartment for apartment in (CASE1, CASE2)}


def draw(apartment: Apartment) -> OccupancyGrid:
    """The apartment's floor plan as a grid."""
    width, height = (round(side / RESOLUTION) for side in apartment.size)
    occupied = np.zeros((height, width), bool)

    def fill(box: Box, value: bool, margin: float = 0.0) -> None:
        x0, y0, x1, y1 = (round(v / RESOLUTION) for v in box)
        m = round(margin / RESOLUTION)
        occupied[max(y0 - m, 0) : y1 + m, max(x0 - m, 0) : x1 + m] = value

    for wall in apartment.walls:
        fill(wall, True, WALL / 2)
    for x0, y0, x1, y1 in apartment.doors:
        across = WALL / 2
        fill((x0, y0 - across, x1, y1 + across) if y0 == y1 else (x0 - across, y0, x1 + across, y1), False)
    for box in apartment.furniture:
        fill(box, True)
    edge = round(WALL / RESOLUTION)
    occupied[:edge] = occupied[-edge:] = True
    occupied[:, :edge] = occupied[:, -edge:] = True
    return OccupancyGrid(occupied, RESOLUTION)


def rooms(apartment: Apartment) -> dict[str, Region]:
    return {
        name: Polygon(((x0, y0), (x1, y0), (x1, y1), (x0, y1)))
        for name, (x0, y0, x1, y1) in apartment.rooms.items()
    }


def files(apartment: Apartment) -> dict[str, bytes]:
    """{file name: content}: the map as map_server has it; regions, rooms, targets and rule as JSON."""
    metadata, image = dump_map(draw(apartment), f"{apartment.name}.pgm")
    beside: dict[str, Any] = {
        "regions": {name: region_to_json(region) for name, region in apartment.regions.items()},
        "rooms": {name: region_to_json(room) for name, room in rooms(apartment).items()},
        "targets": {name: list(point) for name, point in apartment.targets.items()},
        "formula": apartment.formula,
        "instruction": apartment.instruction,
        **({"variants": apartment.variants} if apartment.variants else {}),
    }
    return {
        f"{apartment.name}.yaml": metadata.encode(),
        f"{apartment.name}.pgm": image,
        f"{apartment.name}.regions.json": (json.dumps(beside, indent=1) + "\n").encode(),
    }


def write_maps(folder: Path) -> None:
    """Write the files of every apartment into `folder`."""
    for apartment in APARTMENTS.values():
        for name, content in files(apartment).items():
            (folder / name).write_bytes(content)


if __name__ == "__main__":
    write_maps(Path("maps"))
