"""The paper's algorithm written plainly: torch for the policy, NumPy for the dynamics, rtamt for robustness.

(a) `one_by_one`: each action's rollout by itself, all 19 that do not end, and rtamt on each trajectory.
(b) `batched`: the 7 distinct motions as one batch through torch and NumPy, and our vectorised robustness.
Both see what the shipped DQN sees (policy/dqn/observation.py), computed here in NumPy.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from benchmarks.plain_world import Floats, World, predicate
from specshield.policy.dqn.network import NAMES
from specshield.policy.dqn.observation import DISTANCE_UNIT, SAFE, TIME_UNIT
from specshield.policy.dqn.policy import Policy
from specshield.policy.dqn.scene import make_scene
from specshield.policy.progress.obligations import obligations
from specshield.stl import SATISFIED_ABOVE, Atom, robustness

Ints = NDArray[np.int64]


class Plain:
    """pi_phi and J for the task of a DQN."""

    def __init__(self, dqn: Policy) -> None:
        self.task = task = dqn.task
        self.world, self.parts = World(task), obligations(task.formula)
        assert all(part.kind != "eventually_always" for part in self.parts), "no plain version of F G"
        self.predicates = [predicate(part.predicate, task) for part in self.parts]
        self.scene = make_scene(task)
        self.goals = [k for k, part in enumerate(self.parts) if part.kind == "eventually"]
        self.wait = task.robot.wait_motion
        self.network = _network(dqn)
        self.offline: Callable[[Floats], float] | None = None

    def rollouts(self, history: Floats, first: Ints) -> Floats:
        """The joint trajectories [N, T + 1, 3] after each first motion (N,): pi_phi to the horizon."""
        n, t = len(first), len(history) - 1
        poses = np.empty((n, self.task.horizon + 1, 3))
        poses[:, : t + 1] = history
        settled = np.zeros((n, len(self.parts)), np.bool_)
        broken = np.zeros_like(settled)
        for s in range(t + 1):
            self._advance(s, poses[:, s], settled, broken)
        motions = first
        for s in range(t, self.task.horizon):
            if s > t:
                idle = np.all(settled | broken, axis=1)
                motions = np.full(n, self.wait)
                if not idle.all():
                    motions[~idle] = self._policy(s, poses[~idle, s], settled[~idle], broken[~idle])
            poses[:, s + 1] = self.world.next_poses(poses[:, s], motions)
            self._advance(s + 1, poses[:, s + 1], settled, broken)
        return poses

    def one_by_one(self, history: Floats) -> Floats:
        """(a): rho of each action, [A], -inf for one that ends."""
        if self.offline is None:
            self.offline = _rtamt(self)
        values = np.full(len(self.task.robot.actions), -np.inf)
        for action, motion in enumerate(self.task.robot.motion_of):
            if motion >= 0:
                trajectory = self.rollouts(history, np.array([motion]))[0]
                values[action] = self.offline(trajectory)
        return values

    def batched(self, history: Floats) -> Floats:
        """(b): rho of each action, [A], -inf for one that ends."""
        robot = self.task.robot
        trajectories = self.rollouts(history, np.arange(len(robot.motions)))
        values = robustness(self.task.formula, self.samples(trajectories))
        return np.where(robot.terminal, -np.inf, values[robot.motion_of])

    def samples(self, poses: Floats) -> dict[str, Floats]:
        return {name: predicate(Atom(name), self.task)(poses[..., :2]) for name in self.task.formula.names}

    def _advance(self, t: int, poses: Floats, settled: NDArray[np.bool_], broken: NDArray[np.bool_]) -> None:
        """Takes the states [N, 3] at step t into the progress [N, K], in place."""
        for k, part in enumerate(self.parts):
            if t < part.a:
                continue
            pending = ~(settled[:, k] | broken[:, k])
            holds = self.predicates[k](poses[:, :2]) > SATISFIED_ABOVE
            within = part.a <= t <= part.b
            if part.kind == "eventually":
                met = pending & holds & within
                settled[:, k] |= met
                broken[:, k] |= pending & ~met & (t >= part.b)
            else:
                broke = pending & ~holds & within
                broken[:, k] |= broke
                settled[:, k] |= pending & ~broke & (t >= part.b)

    def _policy(self, t: int, poses: Floats, settled: NDArray[np.bool_], broken: NDArray[np.bool_]) -> Ints:
        observation = torch.from_numpy(self.observe(t, poses, settled, broken))
        with torch.no_grad():
            return self.network(observation).argmax(1).numpy()

    def observe(
        self, t: int, poses: Floats, settled: NDArray[np.bool_], broken: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """What pi_phi sees, [N, F]: time and pose, each obligation's progress, each motion's effect."""
        n, scene, points = len(poses), self.scene, poses[:, :2]
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        motions = len(self.world.motions)
        nexts = self.world.next_poses(np.repeat(poses, motions, axis=0), np.tile(np.arange(motions), n))
        nexts = nexts.reshape(n, motions, 3)
        columns = [np.full(n, t / scene.horizon), cos, sin]
        columns += list(((points - scene.centre) / scene.half).T)
        target, here = np.full(n, -1), np.zeros(n)
        probes = points[:, None] + [[0.0, 0.0], [-0.1, 0.0], [0.1, 0.0], [0.0, -0.1], [0.0, 0.1]]
        near = {k: self._field(k, probes) for k in self.goals}
        for k in sorted(
            self.goals, key=lambda k: self.parts[k].b
        ):  # the pending goal with the nearest deadline
            chosen = (target < 0) & ~settled[:, k] & ~broken[:, k]
            target[chosen], here[chosen] = k, near[k][chosen, 0]
        for k, part in enumerate(self.parts):
            value = self.predicates[k](points)
            if part.kind == "always":
                columns += [np.clip(value / SAFE, -1.0, 1.0), np.full(n, part.a <= t <= part.b)]
                continue
            d, west, east, south, north = near[k].T
            gx, gy = west - east, south - north
            norm = np.maximum(np.hypot(gx, gy), 1e-6)
            columns += [
                settled[:, k],
                np.full(n, np.clip((part.a - t) / TIME_UNIT, 0.0, 2.0)),
                np.full(n, np.clip((part.b - t) / TIME_UNIT, -0.2, 2.0)),
                np.clip(value, -1.0, 1.0),
                np.minimum(d / DISTANCE_UNIT, 2.0),
                d / (d + 0.5),
                (gx * cos + gy * sin) / norm,
                (gy * cos - gx * sin) / norm,
                np.clip(((part.b - t) * scene.stride - d) / DISTANCE_UNIT, -1.0, 1.0),
                np.zeros(n),
            ]
        moved = np.hypot(*np.moveaxis(nexts[:, :, :2] - points[:, None], -1, 0))
        translate, rotate = self.world.motions.T
        full = (moved >= np.abs(translate) - 1e-6) & ((rotate == 0.0) | (nexts[:, :, 2] != poses[:, 2:]))
        gain = np.zeros((n, motions))
        for k in self.goals:
            mine = (target == k)[:, None] & (moved > 0.0)
            if mine.any():
                ahead = here[:, None] - self._field(k, nexts[:, :, :2])
                gain = np.where(mine, np.clip(ahead / scene.stride, -1.5, 1.5), gain)
        safe = np.ones((n, motions))
        for k, part in enumerate(self.parts):
            if part.kind == "always" and part.a <= t + 1 <= part.b:
                after = self.predicates[k](nexts[:, :, :2]) / SAFE
                safe = np.minimum(safe, np.maximum(after, -1.0))
        effects = np.stack([full, gain, safe], axis=-1).reshape(n, -1)
        return np.concatenate([np.stack(columns, axis=-1), effects], axis=1).astype(np.float32)

    def _field(self, k: int, points: Floats) -> Floats:
        """The distance along free space to goal k at points [..., 2], bilinear."""
        field = self.scene.distance[self.scene.goal[k]]
        u, v = np.moveaxis((points - self.world.origin) / self.world.h - 0.5, -1, 0)
        u, v = np.clip(u, 0.0, field.shape[1] - 1.0), np.clip(v, 0.0, field.shape[0] - 1.0)
        i = np.minimum(u.astype(int), field.shape[1] - 2)
        j = np.minimum(v.astype(int), field.shape[0] - 2)
        p, q = u - i, v - j
        low = field[j, i] * (1.0 - p) + field[j, i + 1] * p
        high = field[j + 1, i] * (1.0 - p) + field[j + 1, i + 1] * p
        return low * (1.0 - q) + high * q


def _network(dqn: Policy) -> nn.Module:
    """The shipped weights as an ordinary torch module."""
    layers: list[nn.Module] = []
    arrays = dqn.network._asdict()
    for w, b in zip(NAMES[::2], NAMES[1::2], strict=True):
        layer = nn.Linear(*arrays[w].shape)
        with torch.no_grad():
            layer.weight.copy_(torch.from_numpy(arrays[w].T.copy()))
            layer.bias.copy_(torch.from_numpy(arrays[b]))
        layers += [layer, nn.ReLU()]
    return nn.Sequential(*layers[:-1]).eval()


def _rtamt(plain: Plain) -> Callable[[Floats], float]:
    """rtamt's offline discrete-time robustness at step 0 of a trajectory [T + 1, 3]."""
    import rtamt

    spec = rtamt.StlDiscreteTimeSpecification()
    for name in plain.task.formula.names:
        spec.declare_var(name, "float")
    spec.spec = str(plain.task.formula)
    spec.parse()

    def offline(trajectory: Floats) -> float:
        columns = {name: column.tolist() for name, column in plain.samples(trajectory).items()}
        return float(spec.evaluate({"time": list(range(len(trajectory))), **columns})[0][1])

    return offline
