"""Cheap stand-ins for the foundation model: one that goes somewhere and ends there, and one that wanders.

The first goes to one of the goals (goals.py). The logit of each of its motions is linear in what the motion
saves: metres towards the goal along free space, and turning towards the way there. The second searches: it
goes ahead where it can, else turns, and hardly ever backs up or stands still. Both give the probabilities of
their motions if they do not end, and the chance that they end. Steps that the rule costs them have a price.
A session learns which of them the model is like, where it goes and how sharply (belief.py).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Singles
from specshield.compiled import kernel, leaf
from specshield.lookahead.goals import NO_PATH, Goals, cell_of
from specshield.lookahead.lattice import Planes, Pose, pose_at
from specshield.robot.dynamics import Body, displacement, longest_motions

FEATURES = 4  # of a motion, see `features_of`
WANDER = -1  # in place of a goal: the stand-in that wanders
# The values below were chosen by hand; what the whole is worth is measured by `specshield evaluate`.
END_WITHIN = 1.0  # [m] from its goal, the model may end
END_SLOPE = 0.07  # [m] within which that changes
END_CHANCE = 0.25  # a step, near the goal
WANDER_END = 0.01  # the chance a step that one that wanders ends
AHEAD, TURN, OTHER = 3.3, 2.0, -2.0  # logits when wandering: the longest move ahead, the largest turn, others
PRICE = 1.0  # [nats] of a step that the rule keeps the model from its goal
SEARCH_PRICE = 10.0  # [nats] the same when wandering: the search goes on once the rule is settled
LEAST_MOTION = 1e-9  # [m], [rad] the divisor for a robot without moves, or without turns


@leaf
def follow(goals: Goals, goal: int, style: Floats, pose: Pose, blocked: Bools, out: Floats) -> float:
    """log r of each motion at a pose, into out (M,); returns the chance that the stand-in ends there.

    goal: or WANDER. style (FEATURES,): the logit of each feature. blocked (M,): the motions that an obstacle
    stops short.
    """
    if goal == WANDER:
        _wander(goals.body, blocked, out)
        return WANDER_END
    row, column = cell_of(goals, pose[0], pose[1])
    bearing = bearing_of(goals, goal, row, column, pose[2])
    for m in range(out.shape[0]):
        progress, turning, stopped, idle = features_of(goals.body, bearing, m, blocked[m])
        out[m] = style[0] * progress + style[1] * turning + style[2] * stopped + style[3] * idle
    _normalise(out)
    return end_chance(goals.distance[goal, row, column])


@leaf
def end_chance(distance: int) -> float:
    """The chance a step that the stand-in ends at this distance from its goal [cm]."""
    return END_CHANCE / (1.0 + math.exp(min((distance / 100.0 - END_WITHIN) / END_SLOPE, 50.0)))


@leaf
def bearing_of(goals: Goals, goal: int, row: int, column: int, theta: float) -> float:
    """The turn [rad] from the heading theta [rad] to the way in a cell of the grid; NaN at the goal."""
    wu, wv = float(goals.way[goal, row, column, 0]), float(goals.way[goal, row, column, 1])
    if wu == 0.0 and wv == 0.0:
        return math.nan
    bearing = math.atan2(wv, wu) + math.atan2(goals.body.sin_yaw, goals.body.cos_yaw) - theta
    return (bearing + math.pi) % (2.0 * math.pi) - math.pi


@leaf
def features_of(body: Body, bearing: float, motion: int, blocked: bool) -> tuple[float, float, float, float]:
    """The features of a motion: progress along the way and turning towards it, each as a share of what the
    robot's largest motion can do; whether an obstacle stops it short; whether it stands still.
    """
    move, rotation = displacement(body, motion)
    if move == 0.0 and rotation == 0.0:
        return 0.0, 0.0, 0.0, 1.0
    if blocked:
        return 0.0, 0.0, 1.0, 0.0
    if math.isnan(bearing):
        return 0.0, 0.0, 0.0, 0.0
    stride, turn = _largest(body)
    after = abs((bearing - rotation + math.pi) % (2.0 * math.pi) - math.pi)
    turning = (abs(bearing) - after) / turn if rotation != 0.0 else 0.0
    return move / stride * math.cos(bearing), turning, 0.0, 0.0


@leaf
def _wander(body: Body, blocked: Bools, out: Floats) -> None:
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
    """From logits to logarithms of probabilities."""
    total = 0.0
    for m in range(out.shape[0]):
        total += math.exp(out[m])
    for m in range(out.shape[0]):
        out[m] -= math.log(total)


@leaf
def _largest(body: Body) -> tuple[float, float]:
    """The longest move [m] and the largest turn [rad] of the robot's motions, LEAST_MOTION for none."""
    stride, turn = longest_motions(body)
    return max(stride, LEAST_MOTION), max(turn, LEAST_MOTION)


@leaf
def step_price(goal: int) -> float:
    """The price of a step while the rule is pending [nats]. goal: or WANDER."""
    return SEARCH_PRICE if goal == WANDER else PRICE


@leaf
def price_left(goals: Goals, goal: int, x: float, y: float) -> float:
    """The price of the steps from (x, y) to where the stand-in ends [nats]; 0 where that cannot be told."""
    if goal == WANDER:
        return 0.0
    row, column = cell_of(goals, x, y)
    distance, (stride, _) = goals.distance[goal, row, column], _largest(goals.body)
    if distance == NO_PATH or stride <= LEAST_MOTION:
        return 0.0
    return PRICE * max(float(distance) / 100.0 - END_WITHIN, 0.0) / stride


class StandIn(NamedTuple):
    """What a stand-in does at each pose of the lattice.

    motions [M, H, N]: log r; ends [H, N]: the chance a step that it ends. price: of a step while the rule is
    pending; left [N]: the price of the steps that are left to its goal [nats].
    """

    motions: Singles
    ends: Singles
    price: float
    left: Singles


@kernel
def stand_in_for(goals: Goals, planes: Planes, goal: int, style: Floats) -> StandIn:
    """The stand-in that goes to a goal, or WANDER, at each pose of the lattice."""
    (headings, cells), count = planes.valid.shape, planes.free.shape[0]
    motions = np.zeros((count, headings, cells), np.float32)
    ends, left = np.zeros((headings, cells), np.float32), np.zeros(cells, np.float32)
    log_r, blocked = np.empty(count), np.empty(count, np.bool_)
    for h in range(headings):
        for c in range(cells):
            if not planes.valid[h, c]:
                continue
            pose = pose_at(planes, h, c)
            left[c] = price_left(goals, goal, pose[0], pose[1])
            for m in range(count):
                blocked[m] = planes.free[m, h, c] == 0.0
            ends[h, c] = follow(goals, goal, style, pose, blocked, log_r)
            for m in range(count):
                motions[m, h, c] = log_r[m]
    return StandIn(motions, ends, step_price(goal), left)
