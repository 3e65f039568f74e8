"""Random apartments: rooms cut from a rectangle, doors, furniture, and things in their usual places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from evaluation.apartments import RESOLUTION, WALL, Apartment, Box, draw
from specshield.sim.robot import COMFORT
from specshield.world.occupancy import OccupancyGrid

HABITS = {
    "bowl": ("Kitchen", "counter"),
    "pan": ("Kitchen", "counter"),
    "laptop": ("Office", "desk"),
    "pillow": ("Bedroom", "bed"),
    "remote": ("LivingRoom", "sofa"),
    "soap": ("Bathroom", "basin"),
}
"""What can be looked for: the room it is kept in, and the piece of furniture it is close to."""

ROOMS = ("Kitchen", "LivingRoom", "Bedroom", "Bathroom", "Office")
SMALLEST = 2.4  # [m] side of a room
DOOR = (0.9, 1.1)  # [m]
DOORWAY = 0.7  # [m] kept free on both sides of a door
CLOSE = (0.4, 1.1)  # [m] between a target and its furniture, and between a target and any obstacle

# Along a wall: name, length, depth, chance. In the middle of a room: likewise, the two sides.
AGAINST_WALL: dict[str, tuple[tuple[str, tuple[float, float], tuple[float, float], float], ...]] = {
    "Kitchen": (("counter", (2.0, 4.5), (0.6, 0.7), 1.0), ("counter", (1.2, 4.0), (0.6, 0.7), 0.8)),
    "LivingRoom": (
        ("sofa", (1.6, 2.4), (0.8, 1.0), 1.0),
        ("bench", (1.0, 1.8), (0.4, 0.5), 0.8),
        ("cupboard", (1.0, 1.6), (0.4, 0.5), 0.4),
    ),
    "Bedroom": (("bed", (1.8, 2.2), (1.4, 2.1), 1.0), ("wardrobe", (1.2, 1.8), (0.5, 0.6), 0.9)),
    "Bathroom": (("bath", (1.6, 2.1), (0.7, 0.8), 0.9), ("basin", (0.6, 0.9), (0.5, 0.6), 1.0)),
    "Office": (
        ("desk", (1.4, 1.9), (0.7, 0.9), 1.0),
        ("shelves", (1.2, 3.2), (0.4, 0.5), 0.8),
        ("cupboard", (0.8, 1.6), (0.5, 0.6), 0.4),
    ),
    "Hall": (("cabinet", (0.6, 1.2), (0.3, 0.4), 0.3),),
}
IN_THE_MIDDLE = {
    "Kitchen": ((0.8, 1.2), (0.7, 0.9), 0.5),
    "LivingRoom": ((0.8, 1.3), (0.7, 1.2), 0.7),
    "Office": ((0.6, 0.8), (0.5, 0.7), 0.5),
}
STRAY = (0.4, 0.2)  # chances of a first and a second chair anywhere: beside them the robot cannot turn


@dataclass(frozen=True)
class House:
    """A floor plan. kinds: what each of its rooms is. targets: where each thing to find is, (x, y) [m]."""

    grid: OccupancyGrid
    rooms: tuple[Box, ...]
    kinds: tuple[str, ...]
    targets: dict[str, tuple[float, float]]


def random_house(random: np.random.Generator, size: tuple[float, float, int] | None = None) -> House:
    """An apartment in which a robot that keeps off the walls reaches every room and every target.

    size: width and depth [m], and about how many rooms; drawn where none is given.
    """
    while True:
        house = _furnished(random, size)
        if house is not None:
            return house


def _furnished(random: np.random.Generator, size: tuple[float, float, int] | None) -> House | None:
    width, height = (round(random.uniform(7.5, 12.0), 1) for _ in range(2))
    count = int(random.integers(4, 9))
    if size is not None:
        width, height, count = size
    boxes = _cut((0.0, 0.0, width, height), count, random)
    walls = [
        (i, j, wall) for i in range(len(boxes)) for j in range(i) if (wall := _shared(boxes[i], boxes[j]))
    ]
    doors = _doors(len(boxes), walls, random)
    if doors is None:
        return None
    kinds = _kinds(boxes, walls, random)
    pieces = [
        piece
        for box, kind in zip(boxes, kinds, strict=True)
        for piece in _furniture(box, kind, doors, random)
    ]
    plan = Apartment(
        name="", size=(width, height), walls=tuple(wall for _, _, wall in walls), doors=tuple(doors),
        furniture=tuple(box for _, box in pieces), rooms={}, regions={}, targets={},
        formula="", instruction="",
    )  # fmt: skip
    grid = draw(plan)
    comfortable, parts = label(grid.clearance > COMFORT)
    if parts == 0:
        return None
    largest = comfortable == 1 + np.argmax(np.bincount(comfortable.ravel())[1:])
    for x0, y0, x1, y1 in boxes:
        if not largest[_cells(y0) : _cells(y1), _cells(x0) : _cells(x1)].any():
            return None
    targets = {}
    for name, (room, furniture) in HABITS.items():
        places = [box for piece, box in pieces if piece == furniture]
        rooms = [box for box, kind in zip(boxes, kinds, strict=True) if kind == room]
        if places and rooms:
            point = _beside(places[random.integers(len(places))], rooms[0], largest, grid, random)
            if point is None:
                return None
            targets[name] = point
    return House(grid, tuple(boxes), tuple(kinds), targets) if "bowl" in targets else None


def _cells(length: float) -> int:
    return round(length / RESOLUTION)


def _cut(box: Box, rooms: int, random: np.random.Generator) -> list[Box]:
    """The box cut into about so many, half of the time with a hall from side to side."""
    x0, y0, x1, y1 = box
    boxes = [box]
    if random.random() < 0.5:
        wide = round(random.uniform(1.4, 2.0), 1)
        if random.random() < 0.5:
            low = round(random.uniform(y0 + SMALLEST, y1 - SMALLEST - wide), 1)
            hall, boxes = (x0, low, x1, low + wide), [(x0, y0, x1, low), (x0, low + wide, x1, y1)]
        else:
            low = round(random.uniform(x0 + SMALLEST, x1 - SMALLEST - wide), 1)
            hall, boxes = (low, y0, low + wide, y1), [(x0, y0, low, y1), (low + wide, y0, x1, y1)]
        return [hall, *_halve(boxes, rooms - 1, random)]
    return _halve(boxes, rooms, random)


def _halve(boxes: list[Box], rooms: int, random: np.random.Generator) -> list[Box]:
    """Cuts the largest box that can be cut until there are `rooms`."""
    while len(boxes) < rooms:
        for box in sorted(boxes, key=lambda b: (b[2] - b[0]) * (b[3] - b[1]), reverse=True):
            x0, y0, x1, y1 = box
            sides = (x1 - x0, y1 - y0)
            axis = int(sides[1] > sides[0] * random.uniform(0.8, 1.25))
            if sides[axis] < 2 * SMALLEST:
                axis = 1 - axis
            if sides[axis] < 2 * SMALLEST:
                continue
            at = round(random.uniform(box[axis] + SMALLEST, box[axis + 2] - SMALLEST), 1)
            pair = [(x0, y0, at, y1), (at, y0, x1, y1)] if axis == 0 else [(x0, y0, x1, at), (x0, at, x1, y1)]
            boxes = [b for b in boxes if b is not box] + pair
            break
        else:
            return boxes
    return boxes


def _shared(a: Box, b: Box) -> Box | None:
    """The wall between two rooms, None where they have none in common."""
    x0, y0, x1, y1 = max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])
    if (abs(x1 - x0) < 1e-6 and y1 - y0 > 1e-6) or (abs(y1 - y0) < 1e-6 and x1 - x0 > 1e-6):
        return x0, y0, x1, y1
    return None


def _doors(rooms: int, walls: list[tuple[int, int, Box]], random: np.random.Generator) -> list[Box] | None:
    """Doors that join all rooms and some more; None where the walls are too short for that."""
    part, doors = list(range(rooms)), []
    for k in random.permutation(len(walls)):
        i, j, (x0, y0, x1, y1) = walls[k]
        wide, length = round(random.uniform(*DOOR), 1), max(x1 - x0, y1 - y0)
        if length < wide + 0.6 or (part[i] == part[j] and random.random() < 0.5):
            continue
        at = round(random.uniform(0.3, length - wide - 0.3), 1)
        doors.append((x0 + at, y0, x0 + at + wide, y1) if y0 == y1 else (x0, y0 + at, x1, y0 + at + wide))
        part = [part[i] if p == part[j] else p for p in part]
    return doors if len(set(part)) == 1 else None


def _kinds(boxes: list[Box], walls: list[tuple[int, int, Box]], random: np.random.Generator) -> list[str]:
    """What each room is: the one with the most neighbours a hall, the smallest other one a bathroom."""
    neighbours = np.bincount([i for i, _, _ in walls] + [j for _, j, _ in walls], minlength=len(boxes))
    order = [int(i) for i in random.permutation(len(boxes))]
    hall = max(order, key=lambda i: neighbours[i])
    kinds = ["Bedroom"] * len(boxes)
    kinds[hall] = "Hall"
    left = [i for i in order if i != hall]
    names = ["Kitchen", "LivingRoom", "Bedroom", "Office"]
    if len(left) > 3:
        smallest = min(left, key=lambda i: (boxes[i][2] - boxes[i][0]) * (boxes[i][3] - boxes[i][1]))
        kinds[smallest] = "Bathroom"
        left.remove(smallest)
    for i, name in zip(left, names, strict=False):
        kinds[i] = name
    return kinds


def _furniture(room: Box, kind: str, doors: list[Box], random: np.random.Generator) -> list[tuple[str, Box]]:
    """Pieces that leave the doors free; those that find no place in a few tries are left out."""
    margin = WALL / 2
    x0, y0, x1, y1 = room[0] + margin, room[1] + margin, room[2] - margin, room[3] - margin
    taken = [(a - DOORWAY, b - DOORWAY, c + DOORWAY, d + DOORWAY) for a, b, c, d in doors]
    pieces: list[tuple[str, Box]] = []

    def place(name: str, box: Box, gap: float) -> bool:
        inside = box[0] >= x0 - 1e-6 and box[1] >= y0 - 1e-6 and box[2] <= x1 + 1e-6 and box[3] <= y1 + 1e-6
        others = [(a - gap, b - gap, c + gap, d + gap) for _, (a, b, c, d) in pieces]
        if not inside or any(_overlap(box, other) for other in taken + others):
            return False
        pieces.append((name, box))
        return True

    for name, lengths, depths, chance in AGAINST_WALL[kind]:
        if random.random() >= chance:
            continue
        for _ in range(12):
            side = int(random.integers(4))
            along = (x1 - x0) if side < 2 else (y1 - y0)
            length, depth = min(random.uniform(*lengths), along), random.uniform(*depths)
            at = random.choice([0.0, along - length, random.uniform(0.0, along - length)])
            box = (
                (x0 + at, y0, x0 + at + length, y0 + depth),
                (x0 + at, y1 - depth, x0 + at + length, y1),
                (x0, y0 + at, x0 + depth, y0 + at + length),
                (x1 - depth, y0 + at, x1, y0 + at + length),
            )[side]
            if place(name, box, 0.0):
                break
    if kind in IN_THE_MIDDLE:
        one, other, chance = IN_THE_MIDDLE[kind]
        if random.random() < chance:
            for _ in range(6):
                w, d = random.uniform(*one), random.uniform(*other)
                at_x, at_y = random.uniform(x0, x1), random.uniform(y0, y1)
                if place("table", (at_x, at_y, at_x + w, at_y + d), 0.75):
                    break
    for chance in STRAY:
        if random.random() < chance:
            for _ in range(6):
                w, d = random.uniform(0.3, 0.9, 2)
                at_x, at_y = random.uniform(x0, x1), random.uniform(y0, y1)
                if place("chair", (at_x, at_y, at_x + w, at_y + d), 0.0):
                    break
    return pieces


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] - 1e-6 and b[0] < a[2] - 1e-6 and a[1] < b[3] - 1e-6 and b[1] < a[3] - 1e-6


def _beside(
    piece: Box, room: Box, reachable: NDArray[np.bool_], grid: OccupancyGrid, random: np.random.Generator
) -> tuple[float, float] | None:
    """A point of the room close to a piece of furniture."""
    x, y = grid.centres[..., 0], grid.centres[..., 1]
    away = np.hypot(
        np.maximum(np.maximum(piece[0] - x, x - piece[2]), 0.0),
        np.maximum(np.maximum(piece[1] - y, y - piece[3]), 0.0),
    )
    low, high = CLOSE
    inside = (x > room[0]) & (x < room[2]) & (y > room[1]) & (y < room[3])
    rows, columns = np.nonzero(reachable & inside & (away < high) & (grid.clearance > low))
    if len(rows) == 0:
        return None
    k = random.integers(len(rows))
    return float(x[rows[k], columns[k]]), float(y[rows[k], columns[k]])
