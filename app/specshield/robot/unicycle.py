"""The known dynamics x_{t+1} = f(x_t, a_t) of a unicycle with a circular footprint on an occupancy grid.

One compiled function, `step`, is f for everything: the rollout that certifies an action, training,
simulation. It handles one pose at a time, so its result never depends on a batch's shape.
"""

from __future__ import annotations

import math

from specshield.arrays import Floats, Ints
from specshield.compiled import inlined, leaf
from specshield.robot.body import Body, centre, wrap
from specshield.robot.contact import TOUCH, can_turn, room_around, way_ahead


@inlined
def step(body: Body, x: float, y: float, theta: float, motion: int) -> tuple[float, float, float]:
    """f: the pose after one motion (an index into `Robot.motions`). theta in and out in (-pi, pi]."""
    cos, sin, room = around(body, x, y, theta)
    return step_from(body, x, y, theta, cos, sin, room, motion)


@inlined
def around(body: Body, x: float, y: float, theta: float) -> tuple[float, float, float]:
    """What every motion from a pose needs: cosine and sine of its heading, and how much room [m] it has."""
    return math.cos(theta), math.sin(theta), room_around(body, *centre(body, x, y, theta))


@inlined
def step_from(
    body: Body, x: float, y: float, theta: float, cos: float, sin: float, room: float, motion: int
) -> tuple[float, float, float]:
    """`step`, given what is `around` the pose."""
    if _reach(body, motion) <= room:
        return unhindered(body, x, y, theta, cos, sin, motion)
    far = body.translate[motion]
    return _end(body, x, y, theta, motion, way_ahead(body, x, y, theta, far) if far != 0.0 else 0.0)


@inlined
def _reach(body: Body, motion: int) -> float:
    """How far around the footprint's centre [m] a motion can reach, with room to spare for rounding."""
    # A turn takes the centre no farther than its offset times the angle, or twice its offset.
    swing = math.sqrt(body.offset_x**2 + body.offset_y**2) * min(abs(body.rotate[motion]), 2.0)
    return float(body.radius + abs(body.translate[motion]) + swing + TOUCH)


@inlined
def unhindered(
    body: Body, x: float, y: float, theta: float, cos: float, sin: float, motion: int
) -> tuple[float, float, float]:
    """The pose after a motion that meets nothing."""
    distance, angle = body.translate[motion], body.rotate[motion]
    nx, ny = (x + distance * cos, y + distance * sin) if distance != 0.0 else (x, y)
    return nx, ny, wrap(theta + angle) if angle != 0.0 else theta


@inlined
def _end(
    body: Body, x: float, y: float, theta: float, motion: int, moved: float
) -> tuple[float, float, float]:
    """The pose after a motion whose way is free for `moved` of its distance."""
    distance, angle = body.translate[motion], body.rotate[motion]
    nx, ny = x, y
    if distance != 0.0:
        if moved != distance and not body.stop:
            return x, y, theta
        nx, ny = x + moved * math.cos(theta), y + moved * math.sin(theta)
        if moved != distance:
            return nx, ny, theta
    if angle != 0.0:
        if not can_turn(body, nx, ny, theta, angle):
            return (nx, ny, theta) if body.stop else (x, y, theta)
        theta = wrap(theta + angle)
    return nx, ny, theta


@leaf
def simulate(body: Body, pose: Floats, motions: Ints, out: Floats) -> None:
    """The trajectory of a list of motions. pose (3,), motions (n,), out (n, 3): the poses after each."""
    x, y, theta = pose[0], pose[1], pose[2]
    for k in range(motions.shape[0]):
        x, y, theta = step(body, x, y, theta, motions[k])
        out[k, 0], out[k, 1], out[k, 2] = x, y, theta


@inlined
def successors(body: Body, pose: Floats, out: Floats) -> None:
    """The pose after each motion: `step`, with what the motions share done once. pose (3,), out (M, 3)."""
    x, y, theta = pose[0], pose[1], pose[2]
    cos, sin, room = around(body, x, y, theta)
    last, moved = 0.0, 0.0
    for motion in range(body.translate.shape[0]):
        if _reach(body, motion) <= room:
            nx, ny, nth = unhindered(body, x, y, theta, cos, sin, motion)
        else:
            distance = body.translate[motion]
            if distance != 0.0 and distance != last:
                last, moved = distance, way_ahead(body, x, y, theta, distance)
            nx, ny, nth = _end(body, x, y, theta, motion, moved)
        out[motion, 0], out[motion, 1], out[motion, 2] = nx, ny, nth
