"""A base with two driven wheels, simulated by MuJoCo: a world that is not of our making.

The base weighs 20 kg, drives on two wheels and rests on a caster behind. Its motors have a limited torque,
its wheels slip where the floor gives too little friction, and it slides along what it runs into. A plain
controller executes each motion: it counts the turns of its wheels, and stops when by that count it has
arrived. It knows nothing of walls, and nothing of the wheels' true sizes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from evaluation.worlds.world import RAYS, REACH, SCAN, points_of
from specshield.arrays import Floats
from specshield.sim.cases import Case
from specshield.sim.robot import Pose, SimulatedRobot

STEP = 0.002  # [s] of the simulation; with 0.004 turns of 6 degrees come out as 8
EVERY = 10  # simulation steps between two looks of the controller: 50 Hz
RADIUS, TRACK = 0.05, 0.26  # [m] of the wheels, and between them, as the controller believes
SIZE_ERROR = 0.005  # standard deviation of a wheel's true size, as a share: worn and pressed tyres
FRICTION = (0.4, 1.0)  # of the floor; one value a run: from a dusty tile to a carpet
SPEED, TURN = 0.3, 1.0  # [m/s], [rad/s] at most, as a Stretch's
RAMP = 0.5  # [m/s^2] by which the wheels' speed changes
BRAKE, GAIN = 0.25, 3.0  # [m/s^2], [1/s] by which it slows down towards its goal, so as not to overshoot
ARRIVED = 0.001, math.radians(0.2)  # [m], [rad] from where it is to stop, by its count
LONGEST = 6.0  # [s] for one motion; then it gives up
SETTLE = 0.2  # [s] of standing after each
EYE = 0.2  # [m] height of the scanner, at the origin
WALL, FLOOR = 2, 1  # what collides with what


class WheeledRobot(SimulatedRobot):
    """`pose` is that of the true base: whatever localises it does not err."""

    def __init__(self, case: Case, pose: Pose, random: np.random.Generator) -> None:
        self._model = mujoco.MjModel.from_xml_string(_scene(case, random))
        self._data = mujoco.MjData(self._model)
        self._case = case
        self.last_action: int | None = None
        x, y, theta = pose
        self._data.qpos[:7] = (x, y, RADIUS, math.cos(theta / 2), 0.0, 0.0, math.sin(theta / 2))
        self._wheels = [self._model.joint(name).qposadr[0] for name in ("left", "right")]
        self._base = self._model.body("base").id
        self._stand(SETTLE)

    @property
    def pose(self) -> Pose:  # type: ignore[override]
        x, y, _, w, i, j, k = self._data.qpos[:7].tolist()
        return x, y, math.atan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k))

    def execute(self, action: int) -> None:
        motion = self._case.task.robot.motion_of[action]
        if motion >= 0:
            self._drive(*self._case.task.robot.motions[motion])
        self.last_action = action

    @property
    def touches(self) -> bool:
        """Whether the base, not a wheel of it, touches something."""
        contacts = self._data.contact
        return bool(np.any(self._model.geom_contype[contacts.geom] == WALL))

    def look(self) -> tuple[Floats, Floats]:
        """What the scanner sees: points [n, 2] that are occupied, and that are free."""
        pose = self.pose
        angles = pose[2] + np.linspace(-SCAN / 2, SCAN / 2, RAYS)
        rays = np.stack([np.cos(angles), np.sin(angles), np.zeros(RAYS)], axis=-1)
        ranges, geoms = np.empty(RAYS), np.empty(RAYS, np.int32)
        eye = np.array([pose[0], pose[1], EYE])
        for k in range(RAYS):
            hit = np.full(1, -1, np.int32)
            ranges[k] = mujoco.mj_ray(self._model, self._data, eye, rays[k], None, 1, self._base, hit)
            geoms[k] = hit[0]
        ranges[geoms < 0] = np.inf
        return points_of(pose, np.minimum(ranges, REACH))

    def _drive(self, distance: float, angle: float) -> None:
        begun, wheels, most = self._count(), np.zeros(2), RAMP * EVERY * STEP
        for _ in range(int(LONGEST / (EVERY * STEP))):
            left, right = RADIUS * (self._count() - begun)
            ahead, turn = distance - 0.5 * (left + right), angle - (right - left) / TRACK
            if abs(ahead) < ARRIVED[0] and abs(turn) < ARRIVED[1]:
                break
            v, w = _speed(ahead, SPEED), _speed(0.5 * TRACK * turn, 0.5 * TRACK * TURN)
            wheels += np.clip(np.array([v - w, v + w]) - wheels, -most, most)
            self._data.ctrl[:] = wheels / RADIUS
            mujoco.mj_step(self._model, self._data, EVERY)
        self._stand(SETTLE)

    def _stand(self, seconds: float) -> None:
        self._data.ctrl[:] = 0.0
        mujoco.mj_step(self._model, self._data, int(seconds / STEP))

    def _count(self) -> Floats:
        """[2] rad by which the wheels have turned."""
        turned: Floats = self._data.qpos[self._wheels].copy()
        return turned


def _speed(to_go: float, most: float) -> float:
    """[m/s] of a wheel that has so far to go [m]."""
    return math.copysign(min(most, GAIN * abs(to_go), math.sqrt(2.0 * BRAKE * abs(to_go))), to_go)


def _scene(case: Case, random: np.random.Generator) -> str:
    """The case's walls and furniture, and the base, as MuJoCo's XML."""
    robot, friction = case.task.robot, random.uniform(*FRICTION)
    sizes = RADIUS * (1.0 + SIZE_ERROR * random.standard_normal(2))
    walls = "".join(
        f'<geom type="box" pos="{x:.4f} {y:.4f} 0.5" size="{a:.4f} {b:.4f} 0.5" quat="{w:.9f} 0 0 {k:.9f}" '
        f'contype="{WALL}" conaffinity="{WALL}" friction="0.4"/>'
        for x, y, a, b, w, k in _boxes(case)
    )
    wheels = "".join(
        f'<body name="{name}" pos="0 {side * TRACK / 2} 0"><joint name="{name}" axis="0 1 0" damping="0.02"/>'
        f'<geom type="sphere" size="{size:.6f}" mass="0.5" contype="0" conaffinity="{FLOOR}" '
        f'friction="{friction:.3f}" priority="1"/></body>'
        for name, side, size in zip(("left", "right"), (1.0, -1.0), sizes, strict=True)
    )
    motors = "".join(f'<velocity joint="{name}" kv="5" forcerange="-3 3"/>' for name in ("left", "right"))
    (dx, dy), radius = robot.offset, robot.radius
    solid = f'contype="{WALL}" conaffinity="{WALL}" friction="0.4"'
    hollow, rolls = 'contype="0" conaffinity="0"', f'contype="0" conaffinity="{FLOOR}"'
    return f"""<mujoco><option timestep="{STEP}" integrator="implicitfast" cone="elliptic" impratio="10"/>
<worldbody><geom type="plane" size="0 0 1" contype="{FLOOR}" conaffinity="0"/>{walls}
<body name="base"><freejoint/>
<geom type="cylinder" size="{radius} 0.1" pos="{dx} {dy} 0.1" mass="0" {solid}/>
<geom type="box" size="0.1 0.1 0.05" pos="{dx / 2 - 0.02} {dy} 0.03" mass="19" {hollow}/>
<geom type="sphere" size="0.02" pos="{dx - 0.12} {dy} {0.02 - RADIUS}" mass="0.1" {rolls} friction="0.02"
 priority="1"/>{wheels}</body></worldbody>
<actuator>{motors}</actuator></mujoco>"""


def _boxes(case: Case) -> Iterator[tuple[float, float, float, float, float, float]]:
    """The occupied cells as boxes: centre and half sides [m], and the map's turn (w, z of a quaternion)."""
    grid = case.task.grid
    left, (ox, oy, yaw) = grid.occupied.copy(), grid.origin
    while left.any():
        j, i = divmod(int(np.argmax(left)), grid.width)
        wide = _run(left[j, i:])
        high = _run(left[j:, i : i + wide].all(axis=1))
        left[j : j + high, i : i + wide] = False
        u, v = (i + 0.5 * wide) * grid.resolution, (j + 0.5 * high) * grid.resolution
        x, y = ox + math.cos(yaw) * u - math.sin(yaw) * v, oy + math.sin(yaw) * u + math.cos(yaw) * v
        half = 0.5 * grid.resolution
        yield x, y, wide * half, high * half, math.cos(yaw / 2), math.sin(yaw / 2)


def _run(cells: Any) -> int:
    """How many of cells [n] are true before the first that is not."""
    return len(cells) if cells.all() else int(np.argmin(cells))


def installed() -> Any:
    """The version of MuJoCo that the figures are of."""
    return mujoco.__version__
