"""A robot that has slipped can begin the way that it was on again, at its beginning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from specshield.arrays import Floats, Ints
from specshield.caution.surprise.contact import is_near
from specshield.shield.decision import Carry, Shield
from specshield.shield.proposal import Proposal
from specshield.task import Task

SAME_POSE = 1e-6  # [m] and [rad]: poses this near are one pose


@dataclass(frozen=True)
class Begun:
    """Proposes given ways from x_t, motions [N, T - t]; at later steps, what is left of them."""

    task: Task
    motions: Ints
    id = "the way that was begun"

    def propose(self, history: Floats, signals: Mapping[str, Floats], margin: float) -> Proposal:
        rest = self.motions[:, len(history) - self.task.horizon - 1 :]  # before x_t too short: refused
        return Proposal(rest, int(rest[0, 0]))


def with_begun(shield: Shield, carry: Carry | None, poses: Floats) -> Shield:
    """If the robot stands where it stood, though the action that was drawn last leads elsewhere: the shield
    with one more proposer, of the future that was begun with that action. Otherwise, or if motions are taken
    to be exact, the same shield. poses [t + 1, 3].
    """
    task, uncertain = shield.task, shield.config.uncertainty is not None
    if not uncertain or carry is None or carry.t != len(poses) - 2 or carry.action is None:
        return shield
    motion = int(task.robot.motion_of[carry.action])
    way = carry.witnesses[motion] if motion >= 0 else None
    went, near = carry.next_poses[motion : motion + 1], (SAME_POSE, SAME_POSE)
    if not way or not is_near(poses[-2:-1], poses[-1], near) or is_near(went, poses[-1], near):
        return shield
    wait, rows = bytes([max(task.robot.wait_motion, 0)]), [way[:-1]]
    if task.robot.wait_motion >= 0 and wait in way:  # a robot that is late waits for less long
        rows.append(way.replace(wait, b"", 1))
    again = np.array([[motion, *row] for row in rows], np.int64)
    return replace(shield, proposers=(*shield.proposers, Begun(task, again)))
