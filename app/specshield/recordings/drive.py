"""Judges a drive in a rosbag2 by a rule: whether it was kept, and from which step on no way to keep it was
found.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from specshield.arrays import Floats
from specshield.client.models import Pose, Verdict
from specshield.errors import InputError
from specshield.local import LocalShield

POSES = {  # the types of messages with a pose in one frame, and how to get the pose
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
}
MOST_STEPS = 1_000_000  # of a drive; chosen by hand, some hundred times what a rule can look ahead


class Judged(NamedTuple):
    """lost: the first step from which no future was found that keeps the rule, None if there always was one.
    last: the pose before it. left: the number of steps that the drive lacks to the horizon.
    """

    verdict: Verdict
    steps: int
    lost: int | None
    last: Pose | None
    left: int


def read_drive(bag: Path, step_seconds: float, topic: str | None = None) -> Floats:
    """The poses [n, 3] of a drive: from the first on, the newest one after each `step_seconds`.

    bag: a folder of rosbag2, or a rosbag1 file. topic: of poses in the map's frame; None: the only one.
    Raises InputError.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if not (bag / "metadata.yaml").is_file() and not (bag.suffix == ".bag" and bag.is_file()):
        raise InputError("this is no bag", path="BAG", got=str(bag), expected="a rosbag2 folder or .bag file")
    try:
        with AnyReader([bag], default_typestore=get_typestore(Stores.LATEST)) as reader:
            known = [c for c in reader.connections if c.msgtype in POSES]
            topics = sorted({c.topic for c in known})
            if topic is None and len(topics) == 1:
                topic = topics[0]
            if topic not in topics:
                raise InputError(
                    "no poses there" if topic or not topics else "the bag does not say which poses are meant",
                    path="--topic",
                    got=topic,
                    expected=f"one of {', '.join(topics)}" if topics else f"a bag with {' or '.join(POSES)}",
                )
            meant = [c for c in known if c.topic == topic]  # several nodes may send poses there
            found = [
                (at, _planar(POSES[c.msgtype](reader.deserialize(raw, c.msgtype))))
                for c, at, raw in reader.messages(connections=meant)
            ]
    except InputError:
        raise
    except Exception as error:  # the parsers of rosbags may raise anything for a damaged file
        raise InputError(f"the bag cannot be read: {error}", path="BAG", got=str(bag)) from None
    if not found:
        raise InputError("no poses on this topic", path="--topic", got=topic, expected="at least one")
    # Times count from the first pose: as seconds since 1970 they would be too coarse in a float.
    times = 1e-9 * np.array([at - found[0][0] for at, _ in found])
    if times[-1] > MOST_STEPS * step_seconds:
        told = "the poses are too far apart in time; was a clock set while they were recorded?"
        expected = f"at most {MOST_STEPS:,} steps of {step_seconds:g} s"
        raise InputError(told, path="BAG", got=f"{times[-1]:g} s", expected=expected)
    wanted = np.arange(0.0, times[-1] + 1e-9, step_seconds)
    newest = np.searchsorted(times, wanted + 1e-9, side="right") - 1
    return np.asarray(np.array([pose for _, pose in found])[newest])


def check_drive(shield: LocalShield, poses: Floats) -> Judged:
    """Judges poses [n, 3]: x_0 .. x_{n-1} in the map's frame, a step apart, up to the horizon."""
    horizon = shield.task.horizon
    poses = poses[: horizon + 1]
    actions, lost = len(shield.task.robot.actions), None
    start = tuple(poses[0].tolist())
    session = shield.session(
        initial_pose=start, uncertainty="none", learn_map=False, allow_infeasible=True, max_steps=horizon + 1
    )
    for t, pose in enumerate(poses):
        decision = session.step(pose, np.zeros(actions), main_task_done=False)
        if decision.spec_status == "violated" or (
            decision.spec_status == "pending" and not any(decision.j_values)
        ):
            lost = t
            break
        if decision.spec_status == "satisfied":
            break
    for pose in poses[session.t :]:
        session.record(pose)
    before = None if not lost else tuple(poses[lost - 1].tolist())
    return Judged(session.close(), len(poses), lost, before, horizon + 1 - len(poses))


def told(shield: LocalShield, judged: Judged, step_seconds: float) -> Iterator[str]:
    """The result in lines for people."""
    yield f"rule: {shield.task.formula}"
    yield f"drive: {judged.steps} steps of {step_seconds:g} s"
    if signals := shield.task.signals:
        yield f"no signals are read from a bag; taken for the whole drive: {dict(sorted(signals.items()))}"
    status = judged.verdict.spec_status
    words = {"satisfied": "kept", "violated": "broken", "pending": f"open: {judged.left} steps are missing"}
    yield f"the rule is {words[status]}"
    if judged.lost is None:
        yield "a way to keep it was there at every step"
    elif judged.last is None:
        yield "no way to keep it was found from the first pose on"
    else:
        x, y, theta = judged.last
        at = (judged.lost - 1) * step_seconds
        yield (
            f"a way to keep it was there until step {judged.lost - 1} ({at:g} s), at x {x:.2f}, y {y:.2f}, "
            f"theta {theta:.2f}; none was found from step {judged.lost} on"
        )


def _planar(pose: Any) -> Pose:
    p, q = pose.position, pose.orientation
    if not abs(q.x**2 + q.y**2 + q.z**2 + q.w**2 - 1.0) <= 1e-3:  # NaN is none either
        told, got = "the orientation of a pose is not a unit quaternion", [q.x, q.y, q.z, q.w]
        raise InputError(told, path="BAG", got=got, expected="x, y, z, w with a length of 1")
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    return p.x, p.y, yaw
