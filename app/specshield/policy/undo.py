"""The motions that turn the robot, or take another motion back, as nearly as the robot can."""

from __future__ import annotations

import math

import numpy as np

from specshield.arrays import Floats, Ints
from specshield.compiled import leaf
from specshield.robot import Robot
from specshield.robot.dynamics import Body, displacement, motion_count, step, wrap

SAME_ANGLE = 1e-9  # [rad] angles that differ by less are the same: far above rounding, far below any turn
SAME_POSE = 1e-6  # [m, rad] poses that differ by less are the same: ten times what a contact leaves (SKIN)
NOT_NEEDED, IMPOSSIBLE = -1, -2  # in place of a motion


@leaf
def turning_motion(body: Body) -> int:
    """The first motion that turns the robot and leaves it where it is, -1 where there is none."""
    for motion in range(motion_count(body)):
        ahead, turn = displacement(body, motion)
        if ahead == 0.0 and turn != 0.0:
            return motion
    return -1


@leaf
def turn_by(body: Body, angle: float) -> int:
    """The motion that turns by an angle [rad] and does nothing else; or NOT_NEEDED, or IMPOSSIBLE."""
    if abs(angle) < SAME_ANGLE:
        return NOT_NEEDED
    for motion in range(motion_count(body)):
        ahead, turn = displacement(body, motion)
        if ahead == 0.0 and abs(wrap(turn - angle)) < SAME_ANGLE:
            return motion
    return IMPOSSIBLE


@leaf
def move_back(body: Body, motion: int, moved: float) -> int:
    """The straight move that leads nearest to where the robot was before `motion` took it `moved` metres on;
    NOT_NEEDED where no move brings it nearer by a quarter of the way.
    """
    ahead = moved if displacement(body, motion)[0] > 0.0 else -moved
    best, left = NOT_NEEDED, 0.75 * moved
    for back in range(motion_count(body)):
        length, turn = displacement(body, back)
        if turn == 0.0 and abs(ahead + length) < left:
            best, left = back, abs(ahead + length)
    return best


@leaf
def undo_motion(body: Body, pose: Floats, reached: Floats) -> int:
    """The motion that leads from `reached` (3,) back to `pose` (3,), contact included; NOT_NEEDED where the
    two are the same, IMPOSSIBLE where no motion does it.
    """
    if _is_near(pose[0], pose[1], pose[2], reached):
        return NOT_NEEDED
    for motion in range(motion_count(body)):
        x, y, theta = step(body, reached[0], reached[1], reached[2], motion)
        if _is_near(x, y, theta, pose):
            return motion
    return IMPOSSIBLE


@leaf
def _is_near(x: float, y: float, theta: float, pose: Floats) -> bool:
    turn = abs(theta - pose[2])
    near = min(turn, 2.0 * math.pi - turn) < SAME_POSE
    return bool(abs(x - pose[0]) + abs(y - pose[1]) < SAME_POSE and near)


def undoing_motions(robot: Robot) -> Ints:
    """The two motions, in their order, that undo each motion where nothing is in the way, or nearly so.

    Shape (M, 2), NOT_NEEDED where one or none does it.
    """
    turns = [(0.0, NOT_NEEDED), *((a, m) for m, (d, a) in enumerate(robot.motions) if d == 0.0)]
    moves = [(0.0, NOT_NEEDED), *((d, m) for m, (d, a) in enumerate(robot.motions) if a == 0.0)]

    def back(amount: float, choices: list[tuple[float, int]]) -> int:
        return min(choices, key=lambda choice: abs(amount + choice[0]))[1]

    both = [(back(rotate, turns), back(translate, moves)) for translate, rotate in robot.motions]
    return np.array([(a, b) if a >= 0 else (b, a) for a, b in both], np.int64).reshape(-1, 2)
