"""Cheap stand-ins for the foundation model: one that goes somewhere and ends there, and one that wanders.

The logit of a motion of the first is linear in what it saves: metres towards the goal, along free space, and
turning towards the way there. The second goes ahead where it can, else turns, and hardly ever backs up or
stands still, as whatever searches. The steps that the rule takes from either have a price. Which of them the
model is like, where it goes and how sharply is what a session learns (belief.py). Motions are conditional on
not ending.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from specshield.compiled import kernel, leaf
from specshield.robot.dynamics import Body, displacement, longest_motions
from specshield.world.geodesic import geodesic_distance
from specshield.world.occupancy import OccupancyGrid

Floats = NDArray[np.float64]

PROGRESS, TURNING, BLOCKED, IDLE = range(4)  # the features of a motion
FEATURES = 4
MAX_GOALS = 300
GAP = 0.5  # [m] between goals
WAY_PITCH = 0.1  # [m]
MAX_CELLS = 20_000  # of the grid that ways are kept on
STEER = 5  # cells along the way: what the robot steers for
UNIT = 127  # of a direction's components, as stored
FAR = 65535  # [cm] no way
END_WITHIN, END_SLOPE, END_CHANCE = 1.0, 0.07, 0.25  # [m], [m], a step: an end near the goal
WANDER = -1  # in place of a goal
LEAST = 1e-9  # [m], [rad]: of a robot that has no move, or no turn
AHEAD, TURN, OTHER = 3.3, 2.0, -2.0  # logits of one that wanders: the longest move ahead, the largest turn
WANDER_END = 0.01  # a step
PRICE = 1.0  # [nats] of a step that the rule keeps the model from its goal
SEARCH_PRICE = 10.0  # the same where it wanders: what it would search it searches once the rule is settled


class Goals(NamedTuple):
    """G places that the model may be going to, and the way to each, in the grid frame; cells of `pitch` [m].

    distance [G, h, w]: along space with room to turn, from beside an obstacle to it, and through narrow doors
    where there is no other way [cm]; FAR where there is none at all. way [G, h, w, 2]: the direction (u, v)
    to go, times UNIT; zero at the goal.
    """

    pitch: float
    distance: NDArray[np.uint16]
    way: NDArray[np.int8]


def make_goals(body: Body, grid: OccupancyGrid) -> Goals:
    """Goals all over the space where the robot can turn freely."""
    height, width = grid.occupied.shape
    cells = max(round(WAY_PITCH / grid.resolution), math.ceil(math.sqrt(height * width / MAX_CELLS)), 1)
    pitch = cells * grid.resolution
    middles = [np.arange(n // cells) * cells + cells // 2 for n in (height, width)]
    clearance = body.clearance[np.ix_(*middles)]
    free = clearance > 0.0
    roomy = clearance > body.radius + math.hypot(body.offset_x, body.offset_y)
    places = _places(roomy, max(round(GAP / pitch), 1))
    beside, nearest = distance_transform_edt(~roomy, sampling=pitch, return_indices=True)
    distance = np.empty((len(places), *free.shape), np.uint16)
    way = np.empty((len(places), *free.shape, 2), np.int8)
    for g, (row, column) in enumerate(places):
        goal = np.zeros_like(free)
        goal[row, column] = True
        onward = geodesic_distance(roomy, goal, pitch)
        to_go = onward[tuple(nearest)] + beside
        if np.any(free & np.isinf(to_go)):  # through a door too narrow to turn in
            to_go = np.where(np.isinf(to_go), geodesic_distance(free, goal, pitch), to_go)
        distance[g] = np.where(np.isfinite(to_go), np.minimum(100.0 * to_go, FAR - 1), FAR)
        _steer(_off_first(free, onward, pitch), way[g])
    return Goals(pitch, distance, way)


def _places(roomy: NDArray[np.bool_], gap: int) -> list[tuple[int, int]]:
    """One roomy cell in each square of `gap` cells, the middlemost; the squares grow till they are few."""
    places: list[tuple[int, int]] = []
    for row in range(0, roomy.shape[0], gap):
        for column in range(0, roomy.shape[1], gap):
            found = np.argwhere(roomy[row : row + gap, column : column + gap])
            if len(found):
                r, c = found[int(np.argmin(np.sum((found - (gap - 1) / 2) ** 2, axis=1)))]
                places.append((row + int(r), column + int(c)))
    return places if len(places) <= MAX_GOALS else _places(roomy, gap + 1)


def _off_first(free: NDArray[np.bool_], onward: Floats, pitch: float) -> Floats:
    """What falls along the way to a goal [h, w]: through roomy space; from beside a wall, off it first."""
    reached = np.isfinite(onward)
    off = geodesic_distance(free, reached, pitch)
    return np.where(reached, onward, onward[reached].max(initial=0.0) + pitch + off)


@kernel
def _steer(to_go: Floats, way: NDArray[np.int8]) -> None:
    """The direction from each cell to the one STEER cells down the steepest way."""
    height, width = to_go.shape
    after = np.empty(height * width, np.int64)
    for j in range(height):
        for i in range(width):
            best, at = 0.0, j * width + i
            for dj in range(-1, 2):
                for di in range(-1, 2):
                    row, column = j + dj, i + di
                    inside = 0 <= row < height and 0 <= column < width
                    if (dj != 0 or di != 0) and inside and to_go[row, column] < np.inf:
                        fall = (to_go[j, i] - to_go[row, column]) / math.hypot(dj, di)
                        if fall > best:
                            best, at = fall, row * width + column
            after[j * width + i] = at
    for start in range(height * width):
        at = start
        for _ in range(STEER):
            at = after[at]
        dv, du = at // width - start // width, at % width - start % width
        length = max(math.hypot(du, dv), 1e-9)
        way[start // width, start % width, 0] = round(UNIT * du / length)
        way[start // width, start % width, 1] = round(UNIT * dv / length)


@leaf
def end_chance(distance: int) -> float:
    """The chance that the model ends at this distance from its goal [cm], if it has come there."""
    return END_CHANCE / (1.0 + math.exp(min((distance / 100.0 - END_WITHIN) / END_SLOPE, 50.0)))


@leaf
def cell_of(body: Body, pitch: float, height: int, width: int, x: float, y: float) -> tuple[int, int]:
    """Row and column of the grid of ways."""
    dx, dy = x - body.origin_x, y - body.origin_y
    u = (body.cos_yaw * dx + body.sin_yaw * dy) / pitch
    v = (body.cos_yaw * dy - body.sin_yaw * dx) / pitch
    return min(max(int(v), 0), height - 1), min(max(int(u), 0), width - 1)


@leaf
def follow(
    body: Body,
    goals: Goals,
    goal: int,
    style: Floats,
    x: float,
    y: float,
    theta: float,
    blocked: NDArray[np.bool_],
    features: Floats,
    out: Floats,
) -> float:
    """log r of each motion at a pose, out (M,); the chance that the model ends there. goal: or WANDER.

    style (FEATURES,): the logit of each feature. blocked (M,): motions stopped short. features: scratch.
    """
    if goal == WANDER:
        _wander(body, blocked, out)
        return WANDER_END
    row, column = cell_of(body, goals.pitch, goals.distance.shape[1], goals.distance.shape[2], x, y)
    wu, wv = goals.way[goal, row, column, 0], goals.way[goal, row, column, 1]
    describe(body, wu, wv, theta, blocked, features)
    for m in range(out.shape[0]):
        out[m] = 0.0
        for k in range(FEATURES):
            out[m] += style[k] * features[m, k]
    _normalise(out)
    return end_chance(goals.distance[goal, row, column])


@leaf
def _largest(body: Body) -> tuple[float, float]:
    """The longest move [m] and the largest turn [rad] of the robot's motions, LEAST where it has none."""
    stride, turn = longest_motions(body)
    return max(stride, LEAST), max(turn, LEAST)


@leaf
def step_price(goal: int) -> float:
    """Of a step while the rule is pending [nats]. goal: or WANDER."""
    return SEARCH_PRICE if goal == WANDER else PRICE


@leaf
def price_left(body: Body, goals: Goals, goal: int, x: float, y: float) -> float:
    """The price of the steps from (x, y) to where the model ends [nats]; 0 where that cannot be told."""
    if goal == WANDER:
        return 0.0
    row, column = cell_of(body, goals.pitch, goals.distance.shape[1], goals.distance.shape[2], x, y)
    distance, (stride, _) = goals.distance[goal, row, column], _largest(body)
    if distance == FAR or stride <= LEAST:
        return 0.0
    return PRICE * max(float(distance) / 100.0 - END_WITHIN, 0.0) / stride


@leaf
def _wander(body: Body, blocked: NDArray[np.bool_], out: Floats) -> None:
    stride, turn = _largest(body)
    for m in range(out.shape[0]):
        move, rotation = displacement(body, m)
        if move > 0.0:
            out[m] = 0.0 if blocked[m] else AHEAD * move / stride
        else:
            out[m] = OTHER if move < 0.0 or rotation == 0.0 else TURN * abs(rotation) / turn
    _normalise(out)


@leaf
def _normalise(out: Floats) -> None:
    total = 0.0
    for m in range(out.shape[0]):
        total += math.exp(out[m])
    for m in range(out.shape[0]):
        out[m] -= math.log(total)


@leaf
def describe(body: Body, wu: float, wv: float, theta: float, blocked: NDArray[np.bool_], out: Floats) -> None:
    """The features of each motion, out (M, FEATURES). (wu, wv): the way; blocked (M,): stopped short."""
    here = wu == 0.0 and wv == 0.0
    bearing = math.atan2(wv, wu) + math.atan2(body.sin_yaw, body.cos_yaw) - theta
    bearing = (bearing + math.pi) % (2.0 * math.pi) - math.pi
    stride, turn = _largest(body)
    for m in range(out.shape[0]):
        for k in range(FEATURES):
            out[m, k] = 0.0
        move, rotation = displacement(body, m)
        if move == 0.0 and rotation == 0.0:
            out[m, IDLE] = 1.0
        elif blocked[m]:
            out[m, BLOCKED] = 1.0
        elif not here:
            out[m, PROGRESS] = move / stride * math.cos(bearing)
            after = abs((bearing - rotation + math.pi) % (2.0 * math.pi) - math.pi)
            out[m, TURNING] = (abs(bearing) - after) / turn if rotation != 0.0 else 0.0


@leaf
def is_blocked(body: Body, motion: int, x: float, y: float, theta: float, after: Floats) -> bool:
    """Whether f stopped the motion from (x, y, theta) short; after (3,): where it led."""
    moved = math.hypot(after[0] - x, after[1] - y)
    move, rotation = displacement(body, motion)
    return moved < 0.5 * abs(move) or not (rotation == 0.0 or after[2] != theta)
