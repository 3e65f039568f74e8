"""Room beside its way for a robot that cannot drive backwards.

If such a robot ends up between obstacles that are a little nearer than on its map, it may be able neither to
go on nor to turn round. So futures are preferred on which a somewhat larger footprint would go just as well.
"""

from __future__ import annotations

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.compiled import kernel
from specshield.robot.dynamics import Body, step

# [m] how much larger, chosen by hand (docs/decisions.md): 0.08 and more cost more.
ROOM = 0.05


def widened(body: Body) -> Body:
    """The robot with that larger footprint."""
    return body._replace(radius=body.radius + ROOM)


@kernel
def has_room(wide: Body, pose: Floats, motions: Ints, poses: Floats) -> Bools:
    """Which futures from a pose (3,) lead the larger robot where they lead the robot itself. Shape [N].

    motions [N, L], poses [N, L, 3]: the futures, and where they lead the robot.
    """
    found = np.ones(motions.shape[0], np.bool_)
    for i in range(motions.shape[0]):
        x, y, theta = pose[0], pose[1], pose[2]
        for k in range(motions.shape[1]):
            x, y, theta = step(wide, x, y, theta, motions[i, k])
            if x != poses[i, k, 0] or y != poses[i, k, 1] or theta != poses[i, k, 2]:
                found[i] = False
                break
    return found
