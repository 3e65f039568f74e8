"""The loops of SPOC, PoliFormer and FLaRe, with the fields and shapes found in their sources."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from examples import chores_loop
from specshield.client import ShieldClient
from specshield.errors import InfeasibleStart, LogitsError, PoseError, RobotError
from specshield.local import LocalShield
from specshield.policy.dqn.environment import free_poses
from specshield.robot import STRETCH
from specshield.sim.robot import SimulatedRobot

# As AI2-THOR gives it in `last_event.metadata["agent"]`.
RECORDED = {
    "name": "agent",
    "position": {"x": 4.25, "y": 0.9009921550750732, "z": 7.75},
    "rotation": {"x": -0.0, "y": 90.00001525878906, "z": 0.0},
    "cameraHorizon": 0.0,
    "isStanding": True,
    "inHighFrictionArea": False,
}


@pytest.mark.parametrize(("yaw", "theta"), [(0, 90), (90, 0), (180, -90), (270, 180), (359.5, 90.5)])
def test_their_pose_in_our_frame(yaw, theta):
    x, y, got = chores_loop.pose_of({**RECORDED, "rotation": {"x": 0.0, "y": yaw, "z": 0.0}})
    assert (x, y) == (4.25, 7.75)
    assert math.remainder(got - math.radians(theta), 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert -math.pi < got <= math.pi


def test_their_moves_are_ours():
    """One metre ahead at yaw 30: theirs is (sin, cos) along (x, z); their rotate_left lessens the yaw."""
    yaw = math.radians(30)
    _, _, theta = chores_loop.pose_of({**RECORDED, "rotation": {"y": 30.0}})
    assert (math.cos(theta), math.sin(theta)) == pytest.approx((math.sin(yaw), math.cos(yaw)))
    _, _, left = chores_loop.pose_of({**RECORDED, "rotation": {"y": 0.0}})
    assert left - theta == pytest.approx(STRETCH.actions[STRETCH.action_names.index("l")].rotate)


def test_what_is_not_theirs_is_refused():
    with pytest.raises(PoseError):
        chores_loop.pose_of({"position": {"x": 0.0}, "rotation": {"y": 0.0}})
    chores_loop.check_actions(list(STRETCH.action_names))
    with pytest.raises(RobotError):
        chores_loop.check_actions(STRETCH.action_names[::-1])
    for bad in (np.full(19, 1 / 19), np.full(20, 0.1), np.array([np.nan] * 20), np.eye(20)):
        with pytest.raises(LogitsError):
            chores_loop.logits_of(bad)


def test_logits_give_the_probabilities_back():
    p = np.random.default_rng(0).dirichlet(np.ones(20)).astype(np.float32)
    p[3] = 0.0
    p /= p.sum()
    logits = chores_loop.logits_of(p)
    assert logits[3] == -np.inf
    weights = np.exp(logits - logits.max())
    assert weights / weights.sum() == pytest.approx(p, abs=1e-6)


class World:
    """An AbstractSPOCTask, as far as the loop asks, around a simulated robot."""

    def __init__(self, case, pose):
        self.robot, self.ended, self.names = SimulatedRobot(case, pose), False, []
        self.controller = SimpleNamespace(get_current_agent_full_pose=self.full_pose)
        self.task_info = {"natural_language_spec": case.instruction}

    def full_pose(self):
        x, y, theta = self.robot.pose
        return {
            **RECORDED,
            "position": {"x": x, "y": 0.9, "z": y},
            "rotation": {"y": 90.0 - math.degrees(theta)},
        }

    def get_observations(self):
        return {"raw_navigation_camera": np.zeros((224, 384, 3), np.uint8)}

    def is_done(self):
        return self.ended or len(self.names) >= 600

    def successful_if_done(self):
        return self.robot.at_target

    def step_with_action_str(self, name):
        self.names.append(name)
        self.ended = name == "end"
        self.robot.execute(STRETCH.action_names.index(name))


class Recorded:
    """An agent that draws at random and remembers its draw, where SPOC's does or where allenact's do."""

    def __init__(self, kind):
        self.kind, self.random, self.drawn = kind, np.random.default_rng(0), []

    def get_action_list(self):
        return list(STRETCH.action_names)

    def reset(self):
        self.t, self.cache = 0, {}
        if self.kind == "allenact":
            self.last_action_flat = np.zeros((1, 1), np.int64)

    def memory(self):
        return self.last_action_flat if self.kind == "allenact" else self.cache["last_actions"]

    def get_action(self, observations, goal_spec):
        assert goal_spec.startswith("find a")
        assert observations["raw_navigation_camera"].shape == (224, 384, 3)
        if self.t:
            self.drawn.append(int(self.memory().item()))
        p = self.random.dirichlet(np.ones(20) * 0.3).astype(np.float32)
        p[4] = 0.0
        p = np.eye(20, dtype=np.float32)[4] if self.t == 30 else p / p.sum()
        self.t += 1
        if self.kind == "spoc":
            self.cache["last_actions"] = np.zeros((1, 1), np.int64)
        self.memory()[...] = p.argmax()
        return STRETCH.action_names[p.argmax()], p


@pytest.fixture(params=["a server", "in process"])
def begin(request, server, case):
    """What begins a session at a pose."""
    if request.param == "in process":
        yield lambda pose: LocalShield.shipped(case.name).session(initial_pose=pose)
        return
    with ShieldClient(server.url, timeout=60.0) as client:
        yield lambda pose: client.sessions.create(policy_id=case.name, initial_pose=pose)


@pytest.mark.parametrize("kind", ["spoc", "allenact"])
def test_the_loop_keeps_the_rule_and_tells_the_agent_what_was_executed(begin, case, kind):
    for pose in free_poses(case.task, case.body, 20, np.random.default_rng(3)):
        try:
            session = begin(tuple(pose.tolist()))
            break
        except InfeasibleStart:
            continue
    world, agent = World(case, tuple(pose.tolist())), Recorded(kind)
    chores_loop.drive(world, agent, session)
    assert session.spec_status == "satisfied"
    assert world.names[-1] == "end"
    executed = [STRETCH.action_names.index(name) for name in world.names]
    assert agent.drawn == executed[: len(agent.drawn)]
    assert len(agent.drawn) == 30
