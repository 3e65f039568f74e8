"""What could be kept by one who is told the true world at the start: tables made for it, and the shield's own
simulation in it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from evaluation.worlds.world import STAYS, World
from specshield.episode import make_shield, start
from specshield.errors import InfeasibleStart, PoseError
from specshield.robot.dynamics import step
from specshield.shield.proposal import Proposer
from specshield.sim.robot import Pose
from specshield.stl import SATISFIED_ABOVE, robustness
from specshield.task import Task

Make = Callable[[Task], Proposer]  # makes a policy for a task


def can_keep(world: World, pose: Pose, make: Make) -> bool:
    """Whether a way that keeps the rule is found from the start, with everything known.

    Where someone comes, it may lead around where they stand, or wait until they are gone.
    """
    if world.busy is None:
        return _starts(world.case.task, pose, make)
    return _starts(world.busy.task, pose, make) or _waits(world, pose, make)


def _starts(task: Task, pose: Pose, make: Make) -> bool:
    try:
        start(make_shield([policy_for(task, make)]), pose)
    except (InfeasibleStart, PoseError):
        return False
    return True


@lru_cache(maxsize=8)
def policy_for(task: Task, make: Make) -> Proposer:
    return make(task)


def _waits(world: World, pose: Pose, make: Make) -> bool:
    """Whether some way for the world without anyone keeps the rule when the robot stands still, once someone
    comes, until they are gone.
    """
    task, body = world.case.task, world.case.body
    wait = task.robot.wait_motion
    for motions in policy_for(task, make).propose(np.array([pose]), {}, 0.0).motions.tolist():
        poses, leaves, left = [pose], -1, 0
        while len(poses) <= task.horizon:
            if leaves < 0 and world.is_triggered(poses[-1]):
                leaves = len(poses) - 1 + STAYS
            waits = len(poses) - 1 < leaves
            motion = wait if waits else motions[left]
            left += not waits
            poses.append(step(body, *poses[-1], motion))
        rho = robustness(task.formula, task.samples(np.array(poses)))
        if rho > SATISFIED_ABOVE:
            return True
    return False
