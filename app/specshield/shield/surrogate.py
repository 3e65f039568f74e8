"""A cheap stand-in for the foundation model: it goes somewhere, by the way along free space, and ends there.

The logit of a motion is linear in what it saves: metres towards the goal, and turning towards the way there.
Where to, and how sharply, is what a session learns of its model (belief.py). Motions are conditional on not
ending.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel, leaf
from specshield.robot.unicycle import Body
from specshield.world.geodesic import geodesic_distance
from specshield.world.occupancy import OccupancyGrid

Floats = NDArray[np.float64]

PROGRESS, TURNING, BLOCKED, IDLE = range(4)  # the features of a motion
FEATURES = 4
MAX_GOALS = 300
GAP = 0.5  # [m] between goals
WAY_PITCH = 0.1  # [m]
MAX_CELLS = 20_000  # of the grid that ways are kept on
AHEAD = 5  # cells along the way: what the robot steers for
UNIT = 127  # of a direction's components, as stored
FAR = 65535  # [cm] no way
END_WITHIN, END_SLOPE, END_CHANCE = 1.0, 0.07, 0.25  # [m], [m], a step: an end near the goal


class Goals(NamedTuple):
    """G places that the model may be going to, and the way to each, in the grid frame; cells of `pitch` [m].

    distance [G, h, w]: along free space [cm], FAR where there is no way. way [G, h, w, 2]: the direction (u,
    v) to go, times UNIT; zero at the goal.
    """

    pitch: float
    distance: NDArray[np.uint16]
    way: NDArray[np.int8]


class Course(NamedTuple):
    """Where the model is going, as far as known: the mean of the goals' ways, and of their chances of an end.

    way [h, w, 2]: of a length below 1 where the goals part. ends [h, w]: the chance of an end, a step.
    """

    pitch: float
    way: NDArray[np.float32]
    ends: NDArray[np.float32]


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
    distance = np.empty((len(places), *free.shape), np.uint16)
    way = np.empty((len(places), *free.shape, 2), np.int8)
    for g, (row, column) in enumerate(places):
        goal = np.zeros_like(free)
        goal[row, column] = True
        to_go = _to_go(free, roomy, goal, pitch)
        distance[g] = np.where(np.isfinite(to_go), np.minimum(100.0 * to_go, FAR - 1), FAR)
        _steer(to_go, way[g])
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


def _to_go(
    free: NDArray[np.bool_], roomy: NDArray[np.bool_], goal: NDArray[np.bool_], pitch: float
) -> Floats:
    """Metres to the goal through roomy space [h, w]; from beside an obstacle, off it first."""
    onward = geodesic_distance(roomy, goal, pitch)
    reached = np.isfinite(onward)
    off = geodesic_distance(free, reached, pitch)
    return np.where(reached, onward, onward[reached].max(initial=0.0) + pitch + off)


@kernel
def _steer(to_go: Floats, way: NDArray[np.int8]) -> None:
    """The direction from each cell to the one AHEAD cells down the steepest way."""
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
        for _ in range(AHEAD):
            at = after[at]
        dv, du = at // width - start // width, at % width - start % width
        length = max(math.hypot(du, dv), 1e-9)
        way[start // width, start % width, 0] = round(UNIT * du / length)
        way[start // width, start % width, 1] = round(UNIT * dv / length)


@leaf
def end_chance(distance: int) -> float:
    """The chance that the model ends at this distance from its goal [cm], if it has come there."""
    return END_CHANCE / (1.0 + math.exp(min((distance / 100.0 - END_WITHIN) / END_SLOPE, 50.0)))


@kernel
def chart(goals: Goals, chosen: NDArray[np.int64], weights: Floats) -> Course:
    """The course towards the chosen goals; weights sum to 1."""
    _, height, width = goals.distance.shape
    way, ends = np.zeros((height, width, 2), np.float32), np.zeros((height, width), np.float32)
    for n in range(chosen.shape[0]):
        for j in range(height):
            for i in range(width):
                if goals.distance[chosen[n], j, i] < 200.0 * END_WITHIN:
                    ends[j, i] += weights[n] * end_chance(goals.distance[chosen[n], j, i])
                for k in range(2):
                    way[j, i, k] += weights[n] * goals.way[chosen[n], j, i, k] / UNIT
    return Course(goals.pitch, way, ends)


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
    course: Course,
    style: Floats,
    x: float,
    y: float,
    theta: float,
    blocked: NDArray[np.bool_],
    features: Floats,
    out: Floats,
) -> float:
    """log r of each motion at a pose, out (M,); the chance that the model ends there. features: scratch.

    Where goals part, the mean of their log r: what the KL from a model that has one of them is on average.
    """
    row, column = cell_of(body, course.pitch, course.ends.shape[0], course.ends.shape[1], x, y)
    wu, wv = course.way[row, column, 0], course.way[row, column, 1]
    strength = min(math.hypot(wu, wv), 1.0)
    describe(body, wu, wv, theta, blocked, features)
    react(features, style, strength, out)
    return float(course.ends[row, column])


@leaf
def describe(body: Body, wu: float, wv: float, theta: float, blocked: NDArray[np.bool_], out: Floats) -> None:
    """The features of each motion, out (M, FEATURES). (wu, wv): the way; blocked (M,): stopped short."""
    here = wu == 0.0 and wv == 0.0
    bearing = math.atan2(wv, wu) + math.atan2(body.sin_yaw, body.cos_yaw) - theta
    bearing = (bearing + math.pi) % (2.0 * math.pi) - math.pi
    stride, turn = 1e-9, 1e-9
    for m in range(out.shape[0]):
        stride, turn = max(stride, abs(body.translate[m])), max(turn, abs(body.rotate[m]))
    for m in range(out.shape[0]):
        for k in range(FEATURES):
            out[m, k] = 0.0
        move, rotation = body.translate[m], body.rotate[m]
        if move == 0.0 and rotation == 0.0:
            out[m, IDLE] = 1.0
        elif blocked[m]:
            out[m, BLOCKED] = 1.0
        elif not here:
            out[m, PROGRESS] = move / stride * math.cos(bearing)
            after = abs((bearing - rotation + math.pi) % (2.0 * math.pi) - math.pi)
            out[m, TURNING] = (abs(bearing) - after) / turn if rotation != 0.0 else 0.0


@leaf
def react(features: Floats, style: Floats, strength: float, out: Floats) -> None:
    """The mean log-probability of each motion, out (M,). style (FEATURES,): the logit of each feature.

    strength: the length of the mean way, 1 where all goals agree.
    """
    total = 0.0
    for m in range(features.shape[0]):
        going = style[PROGRESS] * features[m, PROGRESS] + style[TURNING] * features[m, TURNING]
        other = style[BLOCKED] * features[m, BLOCKED] + style[IDLE] * features[m, IDLE]
        total += math.exp(going + other)
        out[m] = strength * going + other
    for m in range(features.shape[0]):
        out[m] -= math.log(total)


@leaf
def is_blocked(body: Body, motion: int, x: float, y: float, theta: float, after: Floats) -> bool:
    """Whether f stopped the motion from (x, y, theta) short; after (3,): where it led."""
    moved = math.hypot(after[0] - x, after[1] - y)
    turned = body.rotate[motion] == 0.0 or after[2] != theta
    return moved < 0.5 * abs(body.translate[motion]) or not turned
