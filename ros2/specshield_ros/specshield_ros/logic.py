"""What the node does, without ROS: a map, poses and logits in, actions out.

A decision is asked for by the model's logits. Where none come for `patience` seconds, the certified
continuation of the last decision goes on by itself, one action a call of `silent`, as long as the robot is
where that continuation leads.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from specshield.errors import InputError, SpecshieldError
from specshield.local import LocalSession, LocalShield
from specshield.robot.dynamics import make_body, step
from specshield.world.nav_msgs import from_occupancy_grid
from specshield.world.occupancy import OccupancyGrid

NEAR = (0.1, 0.2)  # [m], [rad] how far from the continuation the robot may be to go on along it; by hand

Pose = tuple[float, float, float]


@dataclass(frozen=True)
class Told:
    """What came of a step. action: to run, None where there is nothing certified: the robot should stand.

    source: `shield`, `witness` or `stop`. ahead [n, 3]: the certified continuation from x_t on.
    """

    action: int | None
    name: str
    source: str
    status: str
    reason: str
    feasible_mass: float | None
    distribution: tuple[float, ...]
    ahead: Any


class Logic:
    """One rule on one map. rule, regions (JSON), robot (JSON): as the node's parameters have them.

    Raises SpecshieldError for those that cannot be read.
    """

    def __init__(self, rule: str, regions: str, robot: str) -> None:
        self._rule, self._robot = rule, _read("robot", robot, (dict, str))
        self._regions = _read("regions", regions, (dict,))
        self.shield: LocalShield | None = None
        self.session: LocalSession | None = None
        self._grid: OccupancyGrid | None = None
        self._plan: list[int] = []  # the certified actions that follow the one that runs now
        self._leads: Pose | None = None  # where the one that runs now should lead

    def on_map(self, message: Any) -> bool:
        """A nav_msgs/OccupancyGrid; whether it is new, so that a policy was made for it (about a second).

        A new map ends the session: its rule begins anew with the next step. Raises SpecshieldError.
        """
        grid = grid_of(message)
        if self._grid is not None and grid == self._grid:
            return False
        self.shield = LocalShield.make(grid, self._rule, self._regions, robot=self._robot)
        self.session, self._grid, self._plan, self._leads = None, grid, [], None
        return True

    def on_logits(self, pose: Pose, logits: Any) -> Told:
        """A decision at `pose`. The first one begins the session. Raises SpecshieldError."""
        session = self._begun(pose)
        if session.finished:
            return self._stopped("the rule is decided, and the session is over")
        decision = session.step(pose, logits)
        self.session = session  # not before: logits that are refused begin nothing
        self._plan = list(decision.witness or ())
        return self._going(pose, decision.execute, "shield", decision)

    def silent(self, pose: Pose) -> Told:
        """The model says nothing: the next action of the certified continuation, if the robot is on it."""
        session = self.session
        if session is None or session.finished or session.spec_status != "pending" or not self._plan:
            return self._stopped("there is no certified continuation")
        if self._leads is not None and not near(pose, self._leads):
            return self._stopped("the robot is not where the certified continuation leads")
        session.record(pose)
        return self._going(pose, self._plan.pop(0), "witness", None)

    def _begun(self, pose: Pose) -> LocalSession:
        if self.shield is None:
            raise SpecshieldError("there is no map yet", expected="a nav_msgs/OccupancyGrid on ~/map")
        return self.session or self.shield.session(initial_pose=pose)

    def _going(self, pose: Pose, action: int, source: str, decision: Any) -> Told:
        assert self.shield is not None
        assert self.session is not None
        task = self.shield.task
        body, ahead = make_body(task.robot, task.grid), [pose]
        for each in (action, *self._plan):
            motion = int(task.robot.motion_of[each])
            ahead.append(step(body, *ahead[-1], motion) if motion >= 0 else ahead[-1])
        self._leads = ahead[1]
        return Told(
            action,
            task.robot.action_names[action],
            source,
            self.session.spec_status,
            (decision.reason or "") if decision is not None else "the model is silent",
            None if decision is None else decision.feasible_mass,
            () if decision is None else decision.distribution,
            np.array(ahead),
        )

    def _stopped(self, reason: str) -> Told:
        status = "pending" if self.session is None else self.session.spec_status
        return Told(None, "", "stop", status, reason, None, (), np.empty((0, 3)))


def _read(name: str, text: str, kinds: tuple[type, ...]) -> Any:
    """A parameter that is JSON. Raises InputError for what is not, or is none of these kinds."""
    expected = "a JSON object" + (", or a preset's name in quotes" if str in kinds else "")
    try:
        found = json.loads(text)
    except ValueError as error:
        raise InputError(f"not JSON: {error}", path=name, got=text, expected=expected) from None
    if not isinstance(found, kinds):
        raise InputError("not what this parameter holds", path=name, got=found, expected=expected)
    return found


def grid_of(message: Any) -> OccupancyGrid:
    """Of a nav_msgs/OccupancyGrid message, ROS's or rosbags'."""
    info, pose = message.info, message.info.origin
    origin = {
        "position": {k: float(getattr(pose.position, k)) for k in "xyz"},
        "orientation": {k: float(getattr(pose.orientation, k)) for k in "xyzw"},
    }
    told = {"resolution": _rounded(info.resolution), "width": int(info.width), "height": int(info.height)}
    return from_occupancy_grid({**told, "origin": origin}, [int(value) for value in message.data])


def near(pose: Pose, other: Pose) -> bool:
    turn = math.remainder(pose[2] - other[2], 2.0 * math.pi)
    return math.dist(pose[:2], other[:2]) <= NEAR[0] and abs(turn) <= NEAR[1]


def yaw_of(q: Any) -> float:
    """Of a geometry_msgs/Quaternion [rad]."""
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def _rounded(resolution: float) -> float:
    """The message's float32 as the number it was written as: 0.05, not 0.05000000074505806."""
    return float(str(np.float32(resolution)))
