"""The expert that the learned model imitates: it knows the map and takes the shortest way to the target.

Like the way in sim/robot.py, its way keeps off the walls, so that the robot can turn on it. Its answer is a
distribution over the actions: those that lose little against the best one get some probability too.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label

from specshield.compiled import leaf
from specshield.policy.geodesic import geodesic_distance
from specshield.robot.dynamics import Body, displacement, step
from specshield.sim.robot import COMFORT, LOOK_AHEAD
from specshield.world.occupancy import OccupancyGrid

Floats = NDArray[np.float64]

END_WITHIN = 0.75  # [m]
SHARPNESS = 4.0  # [nats] for a step that an action saves
BACKWARDS = 1.5  # [steps] that driving backwards costs more, since it does not see where it goes
OFF = 1000.0  # [m] longer than any way: added where the robot has to get away from a wall first
AT_WALL = 4.0  # [steps] that it costs to be at a wall
LEFT_OVER = 0.02  # share of the distribution that is spread over all tokens but `end`
AHEAD, RIGHT, LEFT, BACK, END, IDLE, LEFT_SMALL, RIGHT_SMALL = range(8)  # Stretch tokens; IDLE: `sub_done`


def ways(grid: OccupancyGrid, targets: list[tuple[float, float]]) -> NDArray[np.float32]:
    """Metres from each cell to each target, first away from the walls and then clear of them. [K, h, w]."""
    free = ~grid.occupied
    parts, _ = label(grid.clearance > COMFORT)
    cells = [tuple(int(i) for i in np.floor(grid.to_grid(t) / grid.resolution)) for t in targets]
    comfortable = parts == parts[cells[0][1], cells[0][0]]
    off_the_wall = geodesic_distance(free, comfortable, grid.resolution)
    nearest = distance_transform_edt(~comfortable, return_distances=False, return_indices=True)
    out = np.empty((len(targets), *free.shape), np.float32)
    for k, (column, row) in enumerate(cells):
        goal = np.zeros_like(free)
        goal[row, column] = True
        onward = geodesic_distance(comfortable, goal, grid.resolution)
        out[k] = np.where(comfortable, onward, OFF + off_the_wall + onward[tuple(nearest)])
    return out


@leaf
def bearing_of_way(body: Body, to_go: NDArray[np.float32], x: float, y: float, theta: float) -> float:
    """The bearing [rad] of the point LOOK_AHEAD cells on along the way, or where it comes off the wall."""
    h = body.resolution
    row, col = math.floor((y - body.origin_y) / h), math.floor((x - body.origin_x) / h)
    at_wall = to_go[row, col] >= OFF
    for _ in range(LOOK_AHEAD):
        if at_wall and to_go[row, col] < OFF:
            break
        best, di, dj = 0.0, 0, 0
        for i in range(-1, 2):
            for j in range(-1, 2):
                r, c = row + i, col + j
                if (i == 0 and j == 0) or r < 0 or c < 0 or r >= to_go.shape[0] or c >= to_go.shape[1]:
                    continue
                steepness = (to_go[row, col] - to_go[r, c]) / math.sqrt(float(i * i + j * j))
                if steepness > best:
                    best, di, dj = steepness, i, j
        row, col = row + di, col + dj
    wx, wy = body.origin_x + (col + 0.5) * h, body.origin_y + (row + 0.5) * h
    bearing = math.atan2(wy - y, wx - x) - theta
    return bearing - 2.0 * math.pi * round(bearing / (2.0 * math.pi))


@leaf
def way_off_the_wall(
    body: Body,
    representative: NDArray[np.int64],
    to_go: NDArray[np.float32],
    x: float,
    y: float,
    theta: float,
) -> int:
    """The token that begins the quickest "turn, then move" where the robot may not be able to turn; -1: none.

    Turns are in steps of 6 degrees, as far as nothing is in the way. What is left after the move counts too:
    the way to go, the turn onto it, and being at a wall still.
    """
    best, token = np.inf, -1
    for side in range(2):
        nudge, turn = (LEFT_SMALL, LEFT) if side == 0 else (RIGHT_SMALL, RIGHT)
        heading = theta
        for k in range(31):
            if k > 0:
                _, _, after = step(body, x, y, heading, _motion(representative, nudge))
                if after == heading:
                    break
                heading = after
            for move in (AHEAD, BACK):
                nx, ny, _ = step(body, x, y, heading, _motion(representative, move))
                if math.hypot(nx - x, ny - y) < 0.05:
                    continue
                left = _metres(body, to_go, nx, ny)
                onward = abs(bearing_of_way(body, to_go, nx, ny, heading)) / math.radians(30.0)
                cost = k // 5 + k % 5 + onward + (left % OFF) / 0.2 + (AT_WALL if left >= OFF else 0.0)
                if move == BACK:
                    cost += 2.0 * BACKWARDS
                if cost < best:
                    best, token = cost, move if k == 0 else nudge if k < 5 else turn
    return token


@leaf
def _metres(body: Body, to_go: NDArray[np.float32], x: float, y: float) -> float:
    h = body.resolution
    return float(to_go[math.floor((y - body.origin_y) / h), math.floor((x - body.origin_x) / h)])


@leaf
def _motion(representative: NDArray[np.int64], token: int) -> int:
    for m in range(representative.shape[0]):
        if representative[m] == token:
            return m
    return -1


@leaf
def advise(
    body: Body,
    representative: NDArray[np.int64],
    to_go: NDArray[np.float32],
    x: float,
    y: float,
    theta: float,
    at_target: bool,
    look_around: bool,
    out: NDArray[np.float32],
) -> None:
    """Writes the expert's distribution over all tokens, shape (A,).

    representative (M,): the token of each motion. at_target: near enough to `end`, and the
    target in view. look_around: turn, to the left.
    """
    bearing = bearing_of_way(body, to_go, x, y, theta)
    first = -1
    if look_around:
        bearing = math.radians(60.0)
    elif _metres(body, to_go, x, y) >= OFF:
        first = way_off_the_wall(body, representative, to_go, x, y, theta)
    turn, stride = math.radians(30.0), 0.2
    for a in range(out.shape[0]):
        out[a] = 0.0
    total = 0.0
    for m in range(representative.shape[0]):
        if representative[m] == IDLE:
            continue
        move, rotate = displacement(body, m)
        nx, ny, ntheta = step(body, x, y, theta, m)
        after = bearing - rotate
        after -= 2.0 * math.pi * round(after / (2.0 * math.pi))
        saved = move / stride * math.cos(bearing) + (abs(bearing) - abs(after)) / turn
        if first >= 0:
            saved = 1.0 if representative[m] == first else 0.0
        elif move < 0.0:
            saved -= BACKWARDS
        moved = math.hypot(nx - x, ny - y)
        if moved < 0.25 * abs(move) or (rotate != 0.0 and ntheta == theta):
            saved = -1.0 - BACKWARDS
        out[representative[m]] = math.exp(SHARPNESS * saved)
        total += out[representative[m]]
    keep = 0.1 if at_target else 1.0
    for a in range(out.shape[0]):
        share = LEFT_OVER / (out.shape[0] - 1)
        out[a] = keep * ((1.0 - LEFT_OVER) * out[a] / total + share)
    out[END] = 1.0 - keep
